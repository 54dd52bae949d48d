"""Hash rows of integers, so that two programs can compare what they store without sending it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import UInt64
from numpy import ndarray
from numpy.typing import NDArray


def hash_columns(*columns: NDArray[Any]) -> UInt64[ndarray, " n"]:
    """Return a 64-bit hash of each row of these integer columns; the same in every process and on every machine.

    Each column is mixed in with SplitMix64 (Steele et al., OOPSLA 2014). It is no protection against forgery.
    """
    hashed = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        hashed = (hashed ^ column.astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        hashed = (hashed ^ (hashed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        hashed = (hashed ^ (hashed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        hashed ^= hashed >> np.uint64(31)
    return hashed
