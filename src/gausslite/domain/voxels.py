"""The voxel grid, unit of the fusion vote and the uplink (Sec. III-E), and batches of complete voxels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt32, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians

MIN_VOXEL_M, MAX_VOXEL_M = 0.001, 1000.0
BITS_PER_AXIS = 21
"""Of a key: three axes fit into 63 bits, so that keys are positive."""
_OFFSET = 1 << (BITS_PER_AXIS - 1)
_MASK = (1 << BITS_PER_AXIS) - 1
TILE_VOXELS = 16
"""Voxels of a tile along each axis."""
_TILE_MASK = sum((_MASK - (TILE_VOXELS - 1)) << (axis * BITS_PER_AXIS) for axis in range(3))


@dataclass(frozen=True, slots=True, eq=False)
class VoxelBatch:
    """The complete content of each listed voxel.

    keys are strictly ascending; gaussians are sorted by voxel, counts[i] of them in keys[i]. A count of 0 is a
    tombstone (the voxel is empty now). kappa_sums are TOTALS of the voxel, never increments, so that an update may
    arrive twice or out of order.
    """

    keys: Int64[ndarray, " v"]
    kappa_sums: UInt64[ndarray, " v"]
    counts: UInt32[ndarray, " v"]
    gaussians: Gaussians
    offsets: Int64[ndarray, " v1"] = field(init=False, repr=False)
    """gaussians[offsets[i] : offsets[i + 1]] belong to keys[i]; kept, as a tile of a large map is read under a lock."""

    def __post_init__(self) -> None:
        v = len(self.keys)
        require_array("voxel batch keys", self.keys, (v,), np.int64)
        require_array("voxel batch kappa_sums", self.kappa_sums, (v,), np.uint64)
        require_array("voxel batch counts", self.counts, (v,), np.uint32)
        if v > 1 and not (np.diff(self.keys) > 0).all():
            raise InvalidInputError("voxel batch keys: expected strictly ascending voxel keys")
        offsets = np.zeros(v + 1, np.int64)
        np.cumsum(self.counts, dtype=np.int64, out=offsets[1:])
        object.__setattr__(self, "offsets", offsets)
        total = int(offsets[-1])
        if total != len(self.gaussians):
            raise InvalidInputError(
                f"voxel batch counts: expected a sum of {len(self.gaussians)} (the Gaussians present), got {total}"
            )

    def __len__(self) -> int:
        return len(self.keys)


@dataclass(frozen=True, slots=True, eq=False)
class RoiSubset:
    """One message of an agent: its updates of some voxels."""

    agent_id: str
    session_id: str
    message_seq: int  # number of the message in its session, for cumulative acknowledgements
    update_seq: int  # sequence number of these updates; in each voxel, the update with the highest one is the latest
    batch: VoxelBatch

    def __post_init__(self) -> None:
        if not self.agent_id:
            raise InvalidInputError("subset agent_id: expected a name, got an empty string")
        if self.message_seq < 0 or self.update_seq < 0:
            raise InvalidInputError(
                f"subset message_seq and update_seq: expected at least 0, got {self.message_seq} and {self.update_seq}"
            )


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """Cubes of size_m metres, aligned to the world's origin; keys pack (i, j, k) = floor(p / size) into 63 bits."""

    size_m: float = 0.10

    def __post_init__(self) -> None:
        if not (np.isfinite(self.size_m) and MIN_VOXEL_M <= self.size_m <= MAX_VOXEL_M):
            raise InvalidInputError(f"voxel size_m: expected {MIN_VOXEL_M} to {MAX_VOXEL_M:g}, got {self.size_m}")

    @property
    def max_coordinate_m(self) -> float:
        """Coordinates must be below this distance from the origin along each axis."""
        return _OFFSET * self.size_m

    def keys(self, points_m: Float32[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
        """Return the key of each point's voxel. Raises InvalidInputError for points outside the grid's range."""
        return _pack(self._voxel_of(points_m))

    def sort_by_voxel(self, points_m: Float32[ndarray, "n 3"]) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " v"]]:
        """Return the points' indices sorted by voxel key, and the start of each voxel in them; the sort is stable.

        Raises InvalidInputError for points outside the grid's range.
        """
        axes = self._voxel_of(points_m)
        low, high = (bound(axes, axis=1, initial=0.0) for bound in (np.min, np.max))
        width_i, width_j, width_k = high - low + 1
        # in a small region, 16-bit numbers have the order of the keys and sort much faster
        if width_i * width_j * width_k <= 1 << 16:
            axes -= low[:, None]
            numbers = (np.array([width_j * width_k, width_k, 1.0]) @ axes).astype(np.uint16)
        else:
            numbers = _pack(axes)
        rows = np.argsort(numbers, kind="stable")
        numbers = numbers[rows]
        first = np.ones(len(rows), np.bool_)
        np.not_equal(numbers[1:], numbers[:-1], out=first[1:])
        return rows, np.flatnonzero(first)

    def indices(self, keys: Int64[ndarray, " n"]) -> Int64[ndarray, "n 3"]:
        """Return the (i, j, k) of the voxels with these keys."""
        ijk = np.stack([(keys >> (2 * BITS_PER_AXIS)) & _MASK, (keys >> BITS_PER_AXIS) & _MASK, keys & _MASK], axis=1)
        return ijk - _OFFSET

    def centres_m(self, keys: Int64[ndarray, " n"]) -> Float32[ndarray, "n 3"]:
        """Return the centres of the voxels with these keys."""
        return ((self.indices(keys) + 0.5) * self.size_m).astype(np.float32)

    def _voxel_of(self, points_m: Float32[ndarray, "n 3"]) -> Float64[ndarray, "3 n"]:
        """Return the integers i, j, k of each point's voxel, axis by axis."""
        # float64: the key must not depend on the rounding of a float32 quotient
        axes = np.ascontiguousarray(points_m.T, np.float64)
        axes /= self.size_m
        np.floor(axes, out=axes)
        if not (np.abs(axes) < _OFFSET).all():
            raise InvalidInputError(
                f"points: expected coordinates within ±{self.max_coordinate_m:g} m, got one outside"
            )
        return axes


def tile_of(key: int) -> int:
    """Return the smallest key of the voxel's tile, which names the tile."""
    return key & _TILE_MASK


def tiles_of(keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the tile of each voxel, see tile_of."""
    return keys & np.int64(_TILE_MASK)


def _pack(axes: Float64[ndarray, "3 n"]) -> Int64[ndarray, " n"]:
    i, j, k = axes.astype(np.int64) + _OFFSET
    packed: Int64[ndarray, " n"] = (i << (2 * BITS_PER_AXIS)) | (j << BITS_PER_AXIS) | k
    return packed


@dataclass(frozen=True, slots=True)
class AxisAlignedBox:
    """A box in the world, in metres; a voxel belongs to it if its centre does. Raises InvalidInputError."""

    min_m: tuple[float, float, float]
    max_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        # a report has hundreds of boxes, for which arrays would take most of its time
        if not all(-np.inf < low <= high < np.inf for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise InvalidInputError(f"box: expected finite min <= max, got {self.min_m} and {self.max_m}")

    @classmethod
    def around(cls, points_m: Float[ndarray, "n 3"]) -> AxisAlignedBox:
        """Return the smallest box with these points. Raises InvalidInputError if one is not finite."""
        (x, y, z), (right, back, top) = points_m.min(axis=0).tolist(), points_m.max(axis=0).tolist()
        return cls((x, y, z), (right, back, top))

    def contains(self, points_m: Float[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for each point in the box or on its faces."""
        low, high = np.array(self.min_m), np.array(self.max_m)
        inside: Bool[ndarray, " n"] = np.logical_and(points_m >= low, points_m <= high).min(axis=1)
        return inside


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
        return np.add.reduceat(values[self.rows], self.starts, dtype=np.uint64)

    def rows_in(self, selected: Bool[ndarray, " v"]) -> Int64[ndarray, " m"]:
        """Return the indices of the points in the selected voxels, voxel by voxel."""
        rows: Int64[ndarray, " m"] = self.rows[np.repeat(selected, self.counts)]
        return rows


def group_by_voxel(gaussians: Gaussians, grid: VoxelGrid) -> VoxelBatch:
    """Return the batch of all voxels of these Gaussians (Sec. III-E), in their order. Raises InvalidInputError."""
    voxels = VoxelIndex.from_points(gaussians.means_m, grid)
    return VoxelBatch(
        voxels.keys, voxels.sums(gaussians.kappa), voxels.counts.astype(np.uint32), gaussians.take(voxels.rows)
    )


def find_in(keys: Int64[ndarray, " v"], wanted: Int64[ndarray, " *n"]) -> Int64[ndarray, " *n"]:
    """Return the place of each wanted key in these ascending ones, -1 for a key that is absent."""
    places = np.searchsorted(keys, wanted)
    is_present = keys.take(places, mode="clip") == wanted if len(keys) else False
    return np.where(is_present, places, -1)


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
    # each run is a part of 0, 1, 2, … moved to where it starts
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
    rows = find_in(batch.keys, np.unique(keys))
    rows = rows[rows >= 0]
    counts, starts = batch.counts[rows], batch.offsets[rows]
    gaussians = batch.gaussians.take(gather_rows(starts, counts))
    return VoxelBatch(batch.keys[rows], batch.kappa_sums[rows], counts, gaussians)
