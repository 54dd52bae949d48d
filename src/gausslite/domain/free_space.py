"""The voxels that cameras have observed as free: blocks of 8 x 8 x 8 voxels with a count of views for each voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.voxels import VoxelGrid

BLOCK_SIDE = 8
BLOCK_VOXELS = BLOCK_SIDE**3
MAX_VIEWS = 3
"""Counts saturate here, so that they fit into two bits."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """keys: the blocks, strictly ascending, in the grid of blocks; counts: views of each voxel, 0 to 3, in C order."""

    keys: Int64[ndarray, " b"]
    counts: UInt8[ndarray, "b 512"]

    def __post_init__(self) -> None:
        require_array("free space keys", self.keys, (None,), np.int64)
        require_array("free space counts", self.counts, (len(self.keys), BLOCK_VOXELS), np.uint8)
        if (np.diff(self.keys) <= 0).any():
            raise InvalidInputError("free space keys: expected strictly ascending block keys")
        if self.counts.max(initial=0) > MAX_VIEWS:
            raise InvalidInputError(f"free space counts: expected at most {MAX_VIEWS} views, got more")

    @classmethod
    def empty(cls) -> FreeSpace:
        """Return free space without blocks."""
        return cls(np.zeros(0, np.int64), np.zeros((0, BLOCK_VOXELS), np.uint8))

    @property
    def free_voxels(self) -> int:
        """Number of voxels that at least one view observed as free."""
        return int(np.count_nonzero(self.counts))

    def replace_blocks(self, newer: FreeSpace) -> FreeSpace:
        """Return this free space with the blocks of `newer` in place of the same blocks."""
        kept = ~np.isin(self.keys, newer.keys)
        keys = np.concatenate([self.keys[kept], newer.keys])
        order = np.argsort(keys)
        return FreeSpace(keys[order], np.concatenate([self.counts[kept], newer.counts])[order])

    def views(self, voxel_keys: Int64[ndarray, " v"], grid: VoxelGrid) -> UInt8[ndarray, " v"]:
        """Return the number of views of each voxel of the grid; 0 outside the blocks."""
        if len(self.keys) == 0 or len(voxel_keys) == 0:
            return np.zeros(len(voxel_keys), np.uint8)
        blocks, cells = split_indices(grid.indices(voxel_keys), grid)
        place = np.minimum(np.searchsorted(self.keys, blocks), len(self.keys) - 1)
        found: UInt8[ndarray, " v"] = np.where(self.keys[place] == blocks, self.counts[place, cells], np.uint8(0))
        return found

    def require_within(self, grid: VoxelGrid) -> None:
        """Raise InvalidInputError for blocks outside the range of the voxels' grid."""
        blocks = block_grid(grid)
        grid.keys(((blocks.indices(self.keys) + 0.5) * blocks.size_m).astype(np.float32))


def block_grid(grid: VoxelGrid) -> VoxelGrid:
    """Return the grid of the blocks."""
    return VoxelGrid(grid.size_m * BLOCK_SIDE)


def split_indices(indices: Int64[ndarray, "n 3"], grid: VoxelGrid) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"]]:
    """Return the block key and the position in the block of voxels with these (i, j, k)."""
    blocks = indices // BLOCK_SIDE
    centres = ((blocks + 0.5) * (grid.size_m * BLOCK_SIDE)).astype(np.float32)
    i, j, k = (indices - blocks * BLOCK_SIDE).T
    return block_grid(grid).keys(centres), (i * BLOCK_SIDE + j) * BLOCK_SIDE + k
