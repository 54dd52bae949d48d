"""Encode exact records of Gaussians, as stores and spools keep them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians

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
"""63 bytes per Gaussian, little-endian, without padding; storing changes no bit."""


def to_records(gaussians: Gaussians) -> NDArray[Any]:
    """Return one packed row per Gaussian, in order."""
    records = np.empty(len(gaussians), RECORD)
    for name in RECORD.names or ():
        records[name] = getattr(gaussians, name)
    return records


def from_bytes(data: bytes) -> Gaussians:
    """Decode packed rows. Raises StorageError if the length is not a multiple of a row."""
    if len(data) % RECORD.itemsize:
        raise StorageError(
            f"stored voxel: expected a multiple of {RECORD.itemsize} bytes, got {len(data)}; the store is damaged"
        )
    records = np.frombuffer(data, RECORD)
    return Gaussians(*(np.ascontiguousarray(records[field.name]) for field in fields(Gaussians)))
