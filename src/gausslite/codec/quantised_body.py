"""The body of a quantised message: about 8 bytes a Gaussian.

One zstd frame with the columns of `_columns`, its size (u32) before it, then the bit fields of the positions. The
Gaussians of a voxel are sorted by position and, in one coarse cell, by kappa. Neighbours are then alike, so the first
scale, the colours and kappa are stored as differences to the Gaussian before. The other two scales are stored as
differences to the first. All differences wrap at the range of their type.
"""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np

from gausslite.codec import _unpack, columns
from gausslite.codec.body_layout import (
    MAX_LABEL_BYTES,
    BodyLayout,
    encode_differences,
    encode_labels,
    encode_voxels,
)
from gausslite.codec.columns import Column, compress_columns, decompress
from gausslite.codec.stored_voxels import CODES, VOXELS, StoredVoxels
from gausslite.domain.errors import CodecError
from gausslite.domain.voxels import VoxelBatch, VoxelGrid

_SYMBOL_BYTES = 1 + 3 + 1 + 3 + 1 + 3
_MAX_BIT_FIELD_BYTES = (3 * columns.MAX_FINE_BITS + 7) // 8
MAX_GAUSSIAN_BYTES = _SYMBOL_BYTES + _MAX_BIT_FIELD_BYTES + MAX_LABEL_BYTES
"""Upper limit before compression."""
_FRAME_SIZE = struct.Struct("<I")


def encode(batch: VoxelBatch, grid: VoxelGrid, layout: BodyLayout) -> bytes:
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
        _columns(layout),
    )
    return _FRAME_SIZE.pack(len(frame)) + frame + packed


def decode(body: bytes, grid: VoxelGrid, layout: BodyLayout, update_seq: int, stated_sums: bool) -> StoredVoxels:
    """Return the voxels of a body, with its codes; Σkappa as stated, or as computed from the Gaussians.

    Raises CodecError, InvalidInputError.
    """
    frame, packed = _split(body)
    raw = decompress(frame, layout.shared_bytes + _SYMBOL_BYTES * layout.gaussians)
    try:
        table, codes, targets = _unpack.unpack(raw, packed, layout.widths, columns.QUAT_STEPS, update_seq, stated_sums)
    except ValueError as error:
        raise CodecError(f"subset: {error}") from error
    voxels = StoredVoxels(np.frombuffer(table, VOXELS), np.frombuffer(codes, CODES), grid.size_m)
    if targets:
        batch = voxels.batch()
        gaussians = replace(batch.gaussians, target=np.frombuffer(targets, "<i2").astype(np.int16))
        return StoredVoxels.exact(replace(batch, gaussians=gaussians), update_seq)
    return voxels


def _columns(layout: BodyLayout) -> list[Column]:
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
