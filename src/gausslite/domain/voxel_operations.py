"""Make, cut and unite words on voxels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt32, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid


def empty_batch() -> VoxelBatch:
    """Nothing said about any voxel."""
    return VoxelBatch(np.zeros(0, np.int64), np.zeros(0, np.uint64), np.zeros(0, np.uint32), Gaussians.empty())


@dataclass(frozen=True, slots=True, eq=False)
class VoxelIndex:
    """The voxels that hold some of these points, in ascending order: rows[starts[i] : starts[i] + counts[i]] lie in
    keys[i], in the order in which they came.
    """

    keys: Int64[ndarray, " v"]
    starts: Int64[ndarray, " v"]
    counts: Int64[ndarray, " v"]
    rows: Int64[ndarray, " n"]

    @classmethod
    def from_points(cls, points_m: Float32[ndarray, "n 3"], grid: VoxelGrid) -> VoxelIndex:
        """Sort points into voxels. Raises InvalidInputError for points out of the grid's reach."""
        rows, starts = grid.sort_by_voxel(points_m)
        return cls(grid.keys(points_m[rows[starts]]), starts, np.diff(starts, append=len(rows)), rows)

    def sums(self, values: UInt32[ndarray, " n"] | UInt64[ndarray, " n"]) -> UInt64[ndarray, " v"]:
        """The sum over each voxel of one value a point."""
        if len(self.starts) == 0:
            return np.zeros(0, np.uint64)
        sums: UInt64[ndarray, " v"] = np.add.reduceat(values[self.rows], self.starts, dtype=np.uint64)
        return sums

    def rows_in(self, chosen: Bool[ndarray, " v"]) -> Int64[ndarray, " m"]:
        """The points in these voxels, voxel by voxel."""
        rows: Int64[ndarray, " m"] = self.rows[np.repeat(chosen, self.counts)]
        return rows


def group_by_voxel(gaussians: Gaussians, grid: VoxelGrid) -> VoxelBatch:
    """A complete word on every voxel that holds any of these Gaussians (Sec. III-E), stable within a voxel.

    Raises InvalidInputError for means out of the grid's reach.
    """
    voxels = VoxelIndex.from_points(gaussians.means_m, grid)
    return VoxelBatch(
        voxels.keys, voxels.sums(gaussians.kappa), voxels.counts.astype(np.uint32), gaussians.take(voxels.rows)
    )


def tombstones(keys: Int64[ndarray, " k"]) -> VoxelBatch:
    """The word "nothing is here any more" on each of these ascending voxels."""
    return VoxelBatch(keys, np.zeros(len(keys), np.uint64), np.zeros(len(keys), np.uint32), Gaussians.empty())


def merge_batches(a: VoxelBatch, b: VoxelBatch) -> VoxelBatch:
    """The words of both, which must have no voxel in common."""
    keys = np.concatenate([a.keys, b.keys])
    order = np.argsort(keys, kind="stable")
    counts = np.concatenate([a.counts, b.counts])
    starts = np.cumsum(counts, dtype=np.int64) - counts
    rows = gather_rows(starts[order], counts[order])
    sums = np.concatenate([a.kappa_sums, b.kappa_sums])
    return VoxelBatch(
        keys[order], sums[order], counts[order], Gaussians.concatenate([a.gaussians, b.gaussians]).take(rows)
    )


def gather_rows(starts: NDArray[Any], counts: NDArray[Any]) -> NDArray[np.int64]:
    """The indices start, start + 1, … of every run (start, count), run after run."""
    ends = np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    shift = np.repeat(starts.astype(np.int64) - (ends - counts), counts)
    rows: NDArray[np.int64] = np.arange(total, dtype=np.int64) + shift
    return rows


def select_voxels(words: VoxelBatch, keep: Bool[ndarray, " v"]) -> VoxelBatch:
    """The words on the voxels where `keep` is true."""
    counts = words.counts[keep]
    rows = gather_rows(words.offsets[:-1][keep], counts)
    return VoxelBatch(words.keys[keep], words.kappa_sums[keep], counts, words.gaussians.take(rows))


def crop_to_box(words: VoxelBatch, box: AxisAlignedBox, grid: VoxelGrid) -> VoxelBatch:
    """The words on the voxels whose centre lies in the box."""
    return select_voxels(words, box.contains(grid.centres_m(words.keys)))


def select_keys(words: VoxelBatch, keys: Int64[ndarray, " k"]) -> VoxelBatch:
    """The words on those of these voxels that have one; keys in any order."""
    return select_voxels(words, np.isin(words.keys, keys))
