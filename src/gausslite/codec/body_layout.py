"""The columns that both bodies of a message share: voxels, kappa, targets and active flags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.columns import Column, PositionPrecision
from gausslite.domain.arrays import require_finite
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch

VOXEL_BYTES = 8 + 8 + 4
MAX_LABEL_BYTES = 4 + 2 + 1
"""Of one Gaussian's kappa, target and active flag."""
_MAX_ABS_VALUE = 1e6
_MIN_LARGEST_COMPONENT = 1e-6


@dataclass(frozen=True, slots=True)
class BodyLayout:
    """Counts and widths from the header; they determine the size of every column."""

    voxels: int
    gaussians: int
    kappa_bytes: int
    target_bytes: int
    precision: PositionPrecision

    @classmethod
    def of(cls, batch: VoxelBatch, precision: PositionPrecision) -> BodyLayout:
        """Return the layout of a batch, with the narrowest kappa and target."""
        largest = int(batch.gaussians.kappa.max(initial=0))
        target = batch.gaussians.target
        narrow = int(target.min(initial=0)) >= -128 and int(target.max(initial=0)) <= 127
        kappa_bytes = 1 if largest < 1 << 8 else 2 if largest < 1 << 16 else 4
        return cls(len(batch), len(batch.gaussians), kappa_bytes, 1 if narrow else 2, precision)

    @property
    def shared_bytes(self) -> int:
        """Bytes of the voxel and label columns before compression."""
        label_bytes = self.gaussians * (self.kappa_bytes + self.target_bytes) + (self.gaussians + 7) // 8
        return self.voxels * VOXEL_BYTES + label_bytes

    @property
    def widths(self) -> tuple[int, int, int, int, int, int]:
        """The fields as `_unpack` takes them."""
        return self.voxels, self.gaussians, self.kappa_bytes, self.target_bytes, *self.precision

    def voxel_columns(self) -> list[Column]:
        """Differences of keys, Σkappa minus that of the voxel's Gaussians, and counts."""
        return [Column(dtype, (self.voxels,)) for dtype in ("<u8", "<u8", "<u4")]

    def label_columns(self) -> list[Column]:
        """Differences of kappa, targets, and active flags as bits."""
        n = self.gaussians
        sizes = (f"<u{self.kappa_bytes}", n), (f"<i{self.target_bytes}", n), ("<u1", (n + 7) // 8)
        return [Column(dtype, (size,)) for dtype, size in sizes]


def encode_voxels(batch: VoxelBatch) -> list[NDArray[Any]]:
    """Return the voxel columns. Numbers wrap at 2^64, so that every Σkappa can be stated."""
    keys = np.diff(batch.keys.astype(np.uint64), prepend=np.uint64(0))
    return [keys, batch.kappa_sums - _sums(batch.gaussians.kappa, batch.offsets), batch.counts]


def decode_voxels(raw: list[NDArray[Any]], layout: BodyLayout) -> tuple[Int64[ndarray, " v"], Int64[ndarray, " v1"]]:
    """Return the keys, and the row at which each voxel begins, with the end. Raises CodecError."""
    keys = np.cumsum(raw[0], dtype=np.uint64).astype(np.int64)
    total = int(raw[2].sum(dtype=np.uint64))
    if total != layout.gaussians:
        raise CodecError(f"subset: voxel counts sum to {total}, expected {layout.gaussians}")
    if (keys < 0).any():
        raise CodecError("subset: expected voxel keys of at least 0, got a negative one")
    if (keys[1:] <= keys[:-1]).any():
        raise CodecError("subset: expected strictly ascending voxel keys, got others")
    return keys, np.concatenate([np.zeros(1, np.int64), np.cumsum(raw[2], dtype=np.int64)])


def decode_kappa_sums(
    raw: list[NDArray[Any]], kappa: NDArray[np.uint32], offsets: Int64[ndarray, " v1"]
) -> NDArray[np.uint64]:
    """Return Σkappa of each voxel."""
    return raw[1].astype(np.uint64) + _sums(kappa, offsets)


def encode_labels(gaussians: Gaussians, layout: BodyLayout) -> list[NDArray[Any]]:
    """Return the label columns."""
    dtype, active = f"<u{layout.kappa_bytes}", np.packbits(gaussians.active, bitorder="little")
    return [encode_differences(gaussians.kappa.astype(dtype)), gaussians.target, active]


def decode_labels(raw: list[NDArray[Any]]) -> tuple[NDArray[np.bool_], NDArray[np.uint32], NDArray[np.int16]]:
    """Return active, kappa and target."""
    kappa, target, active = raw
    flags = np.unpackbits(active, count=len(kappa), bitorder="little").astype(np.bool_)
    return flags, decode_differences(kappa).astype(np.uint32), target.astype(np.int16)


def encode_differences(values: NDArray[Any]) -> NDArray[Any]:
    """Return the difference of each value to the one before, modulo the type's range; the first one to zero."""
    return np.diff(values, axis=0, prepend=np.zeros_like(values[:1]) if len(values) else values)


def decode_differences(differences: NDArray[Any]) -> NDArray[Any]:
    """Return the values of these differences."""
    return np.cumsum(differences, axis=0, dtype=differences.dtype)


def require_encodable(gaussians: Gaussians) -> None:
    """Raise InvalidInputError for values that no body can hold, or that a receiver could not render."""
    for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb"):
        require_finite(f"voxel batch {name}", getattr(gaussians, name))
    if (gaussians.scales_m <= 0).any():
        raise InvalidInputError("voxel batch scales_m: expected positive scales, got zero or less")
    if (gaussians.opacities < 0).any() or (gaussians.opacities > 1).any():
        raise InvalidInputError("voxel batch opacities: expected 0 to 1, got one outside")
    if (np.abs(gaussians.quats_wxyz).max(axis=1, initial=0) < _MIN_LARGEST_COMPONENT).any():
        raise InvalidInputError("voxel batch quats_wxyz: expected rotations, got a zero quaternion")
    for name in ("quats_wxyz", "scales_m", "rgb"):
        if (np.abs(getattr(gaussians, name)) > _MAX_ABS_VALUE).any():
            raise InvalidInputError(f"voxel batch {name}: expected at most {_MAX_ABS_VALUE:g}, got a larger value")


def _sums(kappa: NDArray[np.uint32], offsets: Int64[ndarray, " v1"]) -> NDArray[np.uint64]:
    totals = np.concatenate([np.zeros(1, np.uint64), np.cumsum(kappa, dtype=np.uint64)])
    return np.asarray(totals[offsets[1:]] - totals[offsets[:-1]])
