"""Gaussians as packed rows of bytes: how the words of a voxel lie in a store or a spool, bit for bit."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.gaussians import Gaussians
from gausslite.errors import StorageError

RECORD = np.dtype(
    [
        ("means_m", "<f4", (3,)),
        ("quats_wxyz", "<f4", (4,)),
        ("scales_m", "<f4", (3,)),
        ("opacities", "<f4"),
        ("rgb", "<f4", (3,)),
        ("active", "?"),
        ("kappa", "<u4"),
        ("target", "<i2"),
    ]
)
"""63 bytes a Gaussian, little-endian, unpadded, exact: keeping changes no bit of what an agent said."""


def to_records(gaussians: Gaussians) -> NDArray[Any]:
    """One packed row per Gaussian, in order."""
    records = np.empty(len(gaussians), RECORD)
    for name in RECORD.names or ():
        records[name] = getattr(gaussians, name)
    return records


def from_bytes(data: bytes) -> Gaussians:
    """The Gaussians whose packed rows these are. Raises StorageError when the length is not whole rows."""
    if len(data) % RECORD.itemsize:
        raise StorageError(
            f"stored word: expected a multiple of {RECORD.itemsize} bytes, got {len(data)}; what was stored is damaged"
        )
    records = np.frombuffer(data, RECORD)
    return Gaussians(*(np.ascontiguousarray(records[field.name]) for field in fields(Gaussians)))
