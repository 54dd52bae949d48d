"""Decode sRGB colours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def linear_light(encoded: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Return sRGB colours in [0, 1] as linear light in [0, 1], in the same precision (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
