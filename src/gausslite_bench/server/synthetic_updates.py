"""Make voxel updates of many agents whose areas overlap, without mapping anything."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, group_by_voxel, tombstones

GRID = VoxelGrid(0.10)
GAUSSIANS_PER_VOXEL = 40
DELTA_VOXELS = 30
_ROW_VOXELS = 400
_FILL_VOXELS = 500
_PATCHES = 8


def voxels_batch(voxels: Sequence[int] | NDArray[np.int64], seed: int) -> VoxelBatch:
    """Return these voxels of a slab, by number, each with GAUSSIANS_PER_VOXEL Gaussians."""
    rng = np.random.default_rng(seed)
    cells = np.repeat(np.asarray(voxels, np.int64), GAUSSIANS_PER_VOXEL)
    corners = np.stack([cells % _ROW_VOXELS, cells // _ROW_VOXELS % _ROW_VOXELS, cells // _ROW_VOXELS**2], axis=1)
    n = len(cells)
    means_m = (corners + rng.uniform(0.05, 0.95, (n, 3))) * GRID.size_m
    gaussians = Gaussians(
        means_m=means_m.astype(np.float32),
        quats_wxyz=rng.normal(size=(n, 4)).astype(np.float32),
        scales_m=rng.uniform(0.005, 0.05, (n, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.9, n).astype(np.float32),
        rgb=rng.uniform(0, 1, (n, 3)).astype(np.float32),
        active=np.ones(n, np.bool_),
        kappa=rng.integers(1, 500, n).astype(np.uint32),
        target=np.zeros(n, np.int16),
    )
    return group_by_voxel(gaussians, GRID)


def fill_messages(agent_id: str, first: int, voxels: int) -> Iterator[bytes]:
    """Yield encoded messages that fill these voxels."""
    for seq, start in enumerate(range(first, first + voxels, _FILL_VOXELS), start=1):
        batch = voxels_batch(range(start, min(start + _FILL_VOXELS, first + voxels)), seed=start)
        yield encode_subset(RoiSubset(agent_id, "", seq, seq, batch), GRID)


def delta_messages(agent_id: str, number: int, count: int, first_seq: int) -> list[bytes]:
    """Return encoded updates of the agent's area; half of it is shared with the next agent."""
    area = number * _PATCHES // 2 * DELTA_VOXELS
    batches = [
        voxels_batch(range(start, start + DELTA_VOXELS), number * 100 + patch)
        for patch, start in enumerate(range(area, area + _PATCHES * DELTA_VOXELS, DELTA_VOXELS))
    ]
    return [
        encode_subset(RoiSubset(agent_id, "", seq, seq, batches[seq % _PATCHES]), GRID)
        for seq in range(first_seq, first_seq + count)
    ]


def tombstone_message(agent_id: str, voxels: int, update_seq: int) -> bytes:
    """Return one small message with many tombstones, far from all Gaussians."""
    batch = tombstones(voxels_keys(voxels))
    return encode_subset(RoiSubset(agent_id, "", update_seq, update_seq, batch), GRID)


def voxels_keys(voxels: int) -> np.ndarray:
    """Return the keys of a row of voxels far from the slab."""
    return np.arange(voxels, dtype=np.int64) + (1 << 40)
