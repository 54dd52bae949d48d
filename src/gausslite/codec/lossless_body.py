"""The body of a lossless message: every value as float32, every Gaussian in its place; 40 to 45 bytes a Gaussian."""

from __future__ import annotations

import numpy as np

from gausslite.codec.body_layout import (
    MAX_LABEL_BYTES,
    BodyLayout,
    decode_kappa_sums,
    decode_labels,
    decode_voxels,
    encode_labels,
    encode_voxels,
    require_encodable,
)
from gausslite.codec.columns import Column, compress_columns, decompress_columns
from gausslite.codec.stored_voxels import StoredVoxels
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid

_WIDTHS = {"means_m": 3, "quats_wxyz": 4, "scales_m": 3, "opacities": 1, "rgb": 3}
MAX_GAUSSIAN_BYTES = 4 * sum(_WIDTHS.values()) + MAX_LABEL_BYTES
"""Upper limit before compression."""


def encode(batch: VoxelBatch, grid: VoxelGrid, layout: BodyLayout) -> bytes:
    """Return the body. Raises InvalidInputError if a mean lies outside its voxel."""
    if not _are_inside(batch, grid):
        raise InvalidInputError("voxel batch means_m: expected every mean inside its voxel, got one outside")
    values = [getattr(batch.gaussians, name) for name in _WIDTHS]
    return compress_columns([*encode_voxels(batch), *values, *encode_labels(batch.gaussians, layout)], _columns(layout))


def decode(body: bytes, grid: VoxelGrid, layout: BodyLayout, update_seq: int, stated_sums: bool) -> StoredVoxels:
    """Return the voxels of a body; Σkappa as stated, or computed. Raises CodecError, InvalidInputError."""
    raw = decompress_columns(body, _columns(layout))
    keys, offsets = decode_voxels(raw[:3], layout)
    active, kappa, target = decode_labels(raw[-3:])
    values = {name: column.astype(np.float32) for name, column in zip(_WIDTHS, raw[3:-3], strict=True)}
    gaussians = Gaussians(**values, active=active, kappa=kappa, target=target)
    require_encodable(gaussians)
    batch = VoxelBatch(keys, decode_kappa_sums(raw[:3], kappa, offsets), raw[2].astype(np.uint32), gaussians)
    if not _are_inside(batch, grid):
        raise CodecError("subset means_m: expected every mean inside its voxel, got one outside")
    voxels = StoredVoxels.exact(batch, update_seq)
    return voxels if stated_sums else voxels.with_computed_sums()


def _columns(layout: BodyLayout) -> list[Column]:
    n = layout.gaussians
    values = [Column("<f4", (n,) if width == 1 else (n, width)) for width in _WIDTHS.values()]
    return [*layout.voxel_columns(), *values, *layout.label_columns()]


def _are_inside(batch: VoxelBatch, grid: VoxelGrid) -> bool:
    return np.array_equal(grid.keys(batch.gaussians.means_m), np.repeat(batch.keys, batch.counts))
