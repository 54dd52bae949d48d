"""Create, select and merge voxel batches."""

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
    """Return a batch without voxels."""
    return VoxelBatch(np.zeros(0, np.int64), np.zeros(0, np.uint64), np.zeros(0, np.uint32), Gaussians.empty())


@dataclass(frozen=True, slots=True, eq=False)
class VoxelIndex:
    """Points grouped by voxel, keys ascending: points rows[starts[i] : starts[i] + counts[i]] are in keys[i].

    Within a voxel, the points keep their order.
    """

    keys: Int64[ndarray, " v"]
    starts: Int64[ndarray, " v"]
    counts: Int64[ndarray, " v"]
    rows: Int64[ndarray, " n"]

    @classmethod
    def from_points(cls, points_m: Float32[ndarray, "n 3"], grid: VoxelGrid) -> VoxelIndex:
        """Group points by voxel. Raises InvalidInputError for points outside the grid's range."""
        rows, starts = grid.sort_by_voxel(points_m)
        return cls(grid.keys(points_m[rows[starts]]), starts, np.diff(starts, append=len(rows)), rows)

    def sums(self, values: UInt32[ndarray, " n"] | UInt64[ndarray, " n"]) -> UInt64[ndarray, " v"]:
        """Return the sum of the points' values in each voxel."""
        if len(self.starts) == 0:
            return np.zeros(0, np.uint64)
        sums: UInt64[ndarray, " v"] = np.add.reduceat(values[self.rows], self.starts, dtype=np.uint64)
        return sums

    def rows_in(self, selected: Bool[ndarray, " v"]) -> Int64[ndarray, " m"]:
        """Return the indices of the points in the selected voxels, voxel by voxel."""
        rows: Int64[ndarray, " m"] = self.rows[np.repeat(selected, self.counts)]
        return rows


def group_by_voxel(gaussians: Gaussians, grid: VoxelGrid) -> VoxelBatch:
    """Return the batch of all voxels of these Gaussians (Sec. III-E); their order within a voxel is kept.

    Raises InvalidInputError for means outside the grid's range.
    """
    voxels = VoxelIndex.from_points(gaussians.means_m, grid)
    return VoxelBatch(
        voxels.keys, voxels.sums(gaussians.kappa), voxels.counts.astype(np.uint32), gaussians.take(voxels.rows)
    )


def tombstones(keys: Int64[ndarray, " k"]) -> VoxelBatch:
    """Return a batch of tombstones for these ascending voxel keys."""
    return VoxelBatch(keys, np.zeros(len(keys), np.uint64), np.zeros(len(keys), np.uint32), Gaussians.empty())


def merge_batches(*batches: VoxelBatch) -> VoxelBatch:
    """Return the voxels of all batches, which must be disjoint; empty without batches."""
    if not batches:
        return empty_batch()
    keys = np.concatenate([batch.keys for batch in batches])
    order = np.argsort(keys, kind="stable")
    counts = np.concatenate([batch.counts for batch in batches])
    starts = np.cumsum(counts, dtype=np.int64) - counts
    rows = gather_rows(starts[order], counts[order])
    sums = np.concatenate([batch.kappa_sums for batch in batches])
    gaussians = Gaussians.concatenate([batch.gaussians for batch in batches]).take(rows)
    return VoxelBatch(keys[order], sums[order], counts[order], gaussians)


def replace_voxels(older: VoxelBatch, newer: VoxelBatch) -> VoxelBatch:
    """Return the voxels of both batches; a voxel of both is the newer one."""
    return merge_batches(select_voxels(older, ~np.isin(older.keys, newer.keys)), newer)


def gather_rows(starts: NDArray[Any], counts: NDArray[Any]) -> NDArray[np.int64]:
    """Return the indices start, start + 1, … of every run (start, count), concatenated."""
    ends = np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1]) if len(ends) else 0
    shift = np.repeat(starts.astype(np.int64) - (ends - counts), counts)
    rows: NDArray[np.int64] = np.arange(total, dtype=np.int64) + shift
    return rows


def select_voxels(batch: VoxelBatch, keep: Bool[ndarray, " v"]) -> VoxelBatch:
    """Return the voxels where `keep` is True."""
    counts = batch.counts[keep]
    rows = gather_rows(batch.offsets[:-1][keep], counts)
    return VoxelBatch(batch.keys[keep], batch.kappa_sums[keep], counts, batch.gaussians.take(rows))


def crop_to_box(batch: VoxelBatch, box: AxisAlignedBox, grid: VoxelGrid) -> VoxelBatch:
    """Return the voxels whose centre is in the box."""
    return select_voxels(batch, box.contains(grid.centres_m(batch.keys)))


def select_keys(batch: VoxelBatch, keys: Int64[ndarray, " k"]) -> VoxelBatch:
    """Return the voxels of the batch that are in `keys`, which may be unsorted."""
    wanted = np.unique(keys)
    rows = np.searchsorted(batch.keys, wanted)
    rows = rows[np.append(batch.keys, np.int64(-1))[rows] == wanted]
    counts, starts = batch.counts[rows], batch.offsets[rows]
    gaussians = batch.gaussians.take(gather_rows(starts, counts))
    return VoxelBatch(batch.keys[rows], batch.kappa_sums[rows], counts, gaussians)


def slice_voxels(batch: VoxelBatch, start: int, stop: int) -> VoxelBatch:
    """Return the voxels with the indices start to stop - 1, or fewer at the end of the batch."""
    stop = min(stop, len(batch))
    gaussians = batch.gaussians.take(np.arange(batch.offsets[start], batch.offsets[stop]))
    return VoxelBatch(batch.keys[start:stop], batch.kappa_sums[start:stop], batch.counts[start:stop], gaussians)
