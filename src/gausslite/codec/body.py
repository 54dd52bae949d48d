"""The body of a message: columns that both codings share, then Gaussians quantised or without loss.

Quantised: about 8 bytes a Gaussian. One zstd frame with the columns of `quantised_columns`, its size (u32) before it,
then the bit fields of the positions. The Gaussians of a voxel are sorted by position and, in one coarse cell, by kappa.
Neighbours are then alike, so the first scale, the colours and kappa are stored as differences to the Gaussian before.
The other two scales are stored as differences to the first. All differences wrap at the range of their type.

Lossless: one zstd frame; every value as float32, every Gaussian in its place; 40 to 45 bytes a Gaussian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec import _unpack, columns
from gausslite.codec.columns import Column, PositionPrecision, compress_columns, decompress, decompress_columns
from gausslite.codec.encoded_voxels import CODES, VOXELS, EncodedVoxels
from gausslite.domain.arrays import require_finite
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid

VOXEL_BYTES = 8 + 8 + 4
_LABEL_BYTES = 4 + 2 + 1
"""Of one Gaussian's kappa, target and active flag."""
_MAX_ABS_VALUE = 1e6
_MIN_LARGEST_COMPONENT = 1e-6
_SYMBOL_BYTES = 1 + 3 + 1 + 3 + 1 + 3
_MAX_BIT_FIELD_BYTES = (3 * columns.MAX_FINE_BITS + 7) // 8
_QUANTISED_BYTES = _SYMBOL_BYTES + _MAX_BIT_FIELD_BYTES + _LABEL_BYTES
_FRAME_SIZE = struct.Struct("<I")
_WIDTHS = {"means_m": 3, "quats_wxyz": 4, "scales_m": 3, "opacities": 1, "rgb": 3}
_LOSSLESS_BYTES = 4 * sum(_WIDTHS.values()) + _LABEL_BYTES


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


def encode_quantised(batch: VoxelBatch, grid: VoxelGrid, layout: BodyLayout) -> bytes:
    """Return the body. Raises InvalidInputError if a mean lies outside its voxel."""
    coarse_bits = layout.precision.coarse_bits
    scales = columns.encode_scales(batch.gaussians.scales_m)
    bits = layout.precision.bits(scales)
    voxel = np.repeat(grid.indices(batch.keys), batch.counts, axis=0)
    cells = columns.cells_of(batch.gaussians.means_m, voxel, bits, grid)
    codes = columns.morton_codes(cells, bits, coarse_bits)
    order = np.lexsort((batch.gaussians.kappa, codes, np.repeat(np.arange(len(batch)), batch.counts)))
    gaussians, scales = batch.gaussians.take(order), scales[order]
    starts = batch.offsets[:-1][batch.counts > 0]
    lengths, packed = columns.encode_positions(cells[order], codes[order], bits[order], starts, coarse_bits)
    largest, others = columns.encode_quats(gaussians.quats_wxyz, columns.quat_steps(scales))
    frame = compress_columns(
        [
            *encode_voxels(batch),
            lengths,
            *(encode_differences(scales[:, 0]), scales[:, 1] - scales[:, 0], scales[:, 2] - scales[:, 0]),
            largest,
            *others.T,
            columns.encode_opacities(gaussians.opacities),
            *encode_differences(columns.encode_rgb(gaussians.rgb)).T,
            *encode_labels(gaussians, layout),
        ],
        quantised_columns(layout),
    )
    return _FRAME_SIZE.pack(len(frame)) + frame + packed


def _decode_quantised(
    body: bytes, grid: VoxelGrid, layout: BodyLayout, update_seq: int, stated_sums: bool
) -> EncodedVoxels:
    """Return the voxels of a body, with its codes; Σkappa as stated, or as computed from the Gaussians.

    Raises CodecError, InvalidInputError.
    """
    frame, packed = _split(body)
    raw = decompress(frame, layout.shared_bytes + _SYMBOL_BYTES * layout.gaussians)
    try:
        table, codes, targets = _unpack.unpack(raw, packed, layout.widths, columns.QUAT_STEPS, update_seq, stated_sums)
    except ValueError as error:
        raise CodecError(f"subset: {error}") from error
    voxels = EncodedVoxels(np.frombuffer(table, VOXELS), np.frombuffer(codes, CODES), grid.size_m)
    if targets:
        batch = voxels.batch()
        gaussians = replace(batch.gaussians, target=np.frombuffer(targets, "<i2").astype(np.int16))
        return EncodedVoxels.exact(replace(batch, gaussians=gaussians), update_seq)
    return voxels


def quantised_columns(layout: BodyLayout) -> list[Column]:
    """Voxels; bit lengths, 3 scales, largest component, 3 components, opacities, 3 colours; labels."""
    symbols = [Column("<u1", (layout.gaussians,))] * _SYMBOL_BYTES
    return [*layout.voxel_columns(), *symbols, *layout.label_columns()]


def _split(body: bytes) -> tuple[bytes, bytes]:
    if len(body) < _FRAME_SIZE.size:
        raise CodecError(f"subset: expected a body of at least {_FRAME_SIZE.size} bytes, got {len(body)}")
    end = _FRAME_SIZE.size + _FRAME_SIZE.unpack_from(body)[0]
    if end > len(body):
        raise CodecError(f"subset: expected a frame of at most {len(body) - _FRAME_SIZE.size} bytes, got a longer one")
    return body[_FRAME_SIZE.size : end], body[end:]


def _encode_lossless(batch: VoxelBatch, grid: VoxelGrid, layout: BodyLayout) -> bytes:
    """Return the body. Raises InvalidInputError if a mean lies outside its voxel."""
    if not _are_inside(batch, grid):
        raise InvalidInputError("voxel batch means_m: expected every mean inside its voxel, got one outside")
    values = [getattr(batch.gaussians, name) for name in _WIDTHS]
    return compress_columns(
        [*encode_voxels(batch), *values, *encode_labels(batch.gaussians, layout)], _lossless_columns(layout)
    )


def _decode_lossless(
    body: bytes, grid: VoxelGrid, layout: BodyLayout, update_seq: int, stated_sums: bool
) -> EncodedVoxels:
    """Return the voxels of a body; Σkappa as stated, or computed. Raises CodecError, InvalidInputError."""
    raw = decompress_columns(body, _lossless_columns(layout))
    keys, offsets = decode_voxels(raw[:3], layout)
    active, kappa, target = decode_labels(raw[-3:])
    values = {name: column.astype(np.float32) for name, column in zip(_WIDTHS, raw[3:-3], strict=True)}
    gaussians = Gaussians(**values, active=active, kappa=kappa, target=target)
    require_encodable(gaussians)
    batch = VoxelBatch(keys, decode_kappa_sums(raw[:3], kappa, offsets), raw[2].astype(np.uint32), gaussians)
    if not _are_inside(batch, grid):
        raise CodecError("subset means_m: expected every mean inside its voxel, got one outside")
    voxels = EncodedVoxels.exact(batch, update_seq)
    return voxels if stated_sums else voxels.with_computed_sums()


def _lossless_columns(layout: BodyLayout) -> list[Column]:
    n = layout.gaussians
    values = [Column("<f4", (n,) if width == 1 else (n, width)) for width in _WIDTHS.values()]
    return [*layout.voxel_columns(), *values, *layout.label_columns()]


def _are_inside(batch: VoxelBatch, grid: VoxelGrid) -> bool:
    return np.array_equal(grid.keys(batch.gaussians.means_m), np.repeat(batch.keys, batch.counts))


class SubsetCoding(IntEnum):
    """How a message stores Gaussians: quantised to the precision that views need, or without any loss."""

    QUANTISED = 0
    LOSSLESS = 1


class BodyCoder(NamedTuple):
    """The largest size of a Gaussian before compression, and the functions of a coding."""

    gaussian_bytes: int
    encode: Callable[[VoxelBatch, VoxelGrid, BodyLayout], bytes]
    decode: Callable[[bytes, VoxelGrid, BodyLayout, int, bool], EncodedVoxels]


CODERS: dict[int, BodyCoder] = {
    SubsetCoding.QUANTISED: BodyCoder(_QUANTISED_BYTES, encode_quantised, _decode_quantised),
    SubsetCoding.LOSSLESS: BodyCoder(_LOSSLESS_BYTES, _encode_lossless, _decode_lossless),
}
