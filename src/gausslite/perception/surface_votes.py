"""The measured surface of an object: voxels that masks of several frames vote inside or outside the object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.voxels import VoxelGrid
from gausslite.perception.surface_parts import NEIGHBOUR_OFFSETS, is_in_large_part

VOXEL_SIZES_M: Final = (0.00625, 0.0125, 0.025)
"""Edges of the voxels, finest first; each voxel consists of eight of the next finer size."""
_EXTENT_VOXELS: Final = 12
_MAX_VOXELS: Final = 60_000
_MAX_INSIDE_VOXELS: Final = 15_000
# median distance to the middle of a disc, times this number, is its diameter
_DIAMETERS: Final = 2.8
_BOTTOM_PERCENTILE: Final = 0.5


@dataclass(frozen=True, eq=False)
class SurfaceVotes:
    """Votes of voxels: in how many frames their visible pixels were inside the object's mask, or outside.

    keys: ascending, without duplicates, in a grid of voxel_m, one of VOXEL_SIZES_M: the finest whose votes fit the
    memory. An object's surface consists of the voxels with at least as many votes inside as outside, and of their
    neighbours without votes, because depth is inexact. A mask that once spills over to a wall is outvoted by the frames
    that show the wall outside the mask; small parts that are apart from the object are left out.
    """

    keys: Int64[ndarray, " n"]
    inside: Int64[ndarray, " n"]
    outside: Int64[ndarray, " n"]
    voxel_m: float = VOXEL_SIZES_M[0]

    @classmethod
    def empty(cls) -> SurfaceVotes:
        """Return no votes."""
        none = np.zeros(0, np.int64)
        return cls(none, none, none)

    @classmethod
    def from_points(cls, points_m: Float64[ndarray, "n 3"], is_inside: Bool[ndarray, " n"]) -> SurfaceVotes:
        """Return one frame's votes: one for each voxel, by the majority of its points in the world."""
        voxel_m = VOXEL_SIZES_M[0]
        keys, voxel = np.unique(VoxelGrid(voxel_m).keys(points_m.astype(np.float32)), return_inverse=True)
        total = np.bincount(voxel, minlength=len(keys))
        inside = (2 * np.bincount(voxel, weights=is_inside, minlength=len(keys)) > total).astype(np.int64)
        return cls(keys, inside, 1 - inside, voxel_m)._limited()

    def add(self, other: SurfaceVotes) -> SurfaceVotes:
        """Return the sums of both votes, in the coarser grid of both."""
        voxel_m = max(self.voxel_m, other.voxel_m)
        both = [each.coarsened(voxel_m) for each in (self, other)]
        keys = np.concatenate([each.keys for each in both])
        inside = np.concatenate([each.inside for each in both])
        outside = np.concatenate([each.outside for each in both])
        return _summed(keys, inside, outside, voxel_m)._limited()

    def coarsened(self, voxel_m: float) -> SurfaceVotes:
        """Return the sums of the votes in voxels of at least voxel_m, one of VOXEL_SIZES_M."""
        if voxel_m <= self.voxel_m:
            return self
        if voxel_m not in self._coarsened:
            keys = VoxelGrid(voxel_m).keys(self._grid.centres_m(self.keys))
            self._coarsened[voxel_m] = _summed(keys, self.inside, self.outside, voxel_m)
        return self._coarsened[voxel_m]

    @cached_property
    def extent_m(self) -> float:
        """Diameter of a disc with the surface's median distance from its middle; 0 without a surface."""
        centres = self.surface_m.astype(np.float64)
        if len(centres) == 0:
            return 0.0
        distances_m = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
        return _DIAMETERS * float(np.median(distances_m))

    def lowest_m(self, up: Float64[ndarray, "3"]) -> float:
        """Return the level of the surface's bottom, along up in the world; NaN without a surface."""
        levels_m = self.surface_m.astype(np.float64) @ up
        return float(np.percentile(levels_m, _BOTTOM_PERCENTILE)) if len(levels_m) else np.nan

    def resolved(self, min_voxel_m: float) -> SurfaceVotes:
        """Return the votes in voxels of a twelfth of the extent, and of at least min_voxel_m."""
        wanted_m = max(min_voxel_m, self.extent_m / _EXTENT_VOXELS)
        sizes = [size for size in VOXEL_SIZES_M if size <= 2**0.5 * wanted_m]
        return self.coarsened(max(sizes, default=VOXEL_SIZES_M[0]))

    @cached_property
    def _coarsened(self) -> dict[float, SurfaceVotes]:
        """The votes in the coarser grids that were asked for."""
        return {}

    def _limited(self) -> SurfaceVotes:
        """Return the votes in a coarser grid if the surface is too large for memory, without the least voted voxels."""
        if len(self.keys) <= _MAX_VOXELS:
            return self
        if np.count_nonzero(self.inside) > _MAX_INSIDE_VOXELS and self.voxel_m < VOXEL_SIZES_M[-1]:
            coarser = next(size for size in VOXEL_SIZES_M if size > self.voxel_m)
            return self.coarsened(coarser)._limited()
        kept = np.sort(np.lexsort((-self.outside, -self.inside))[:_MAX_VOXELS])
        return SurfaceVotes(self.keys[kept], self.inside[kept], self.outside[kept], self.voxel_m)

    def is_on_surface(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel of the object's surface."""
        return _is_member(self._grid.keys(points_m.astype(np.float32)), self.surface_keys)

    @property
    def _grid(self) -> VoxelGrid:
        return VoxelGrid(self.voxel_m)

    @cached_property
    def _is_inside(self) -> Bool[ndarray, " n"]:
        is_inside = self.inside >= self.outside
        is_inside[is_inside] = is_in_large_part(self._grid.centres_m(self.keys[is_inside]), self.inside[is_inside])
        return is_inside

    @cached_property
    def _inside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[self._is_inside]
        return keys

    @cached_property
    def _outside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[~self._is_inside]
        return keys

    def is_surely_inside(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel of the surface that touches no voxel with more votes outside."""
        return self._is_far_from(points_m, self._inside_keys, self._outside_keys)

    def is_surely_outside(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel with more votes outside that touches no voxel of the surface."""
        return self._is_far_from(points_m, self._outside_keys, self._inside_keys)

    def _is_far_from(
        self, points_m: Float64[ndarray, "n 3"], own: Int64[ndarray, " m"], others: Int64[ndarray, " k"]
    ) -> Bool[ndarray, " n"]:
        """Return True for points in an own voxel without a neighbour among the others."""
        keys, voxel = np.unique(self._grid.keys(points_m.astype(np.float32)), return_inverse=True)
        is_far = _is_member(keys, own)
        rows = np.flatnonzero(is_far)
        near = (keys[rows, None] + NEIGHBOUR_OFFSETS).reshape(-1)
        is_far[rows] = ~_is_member(near, others).reshape(len(rows), len(NEIGHBOUR_OFFSETS)).any(axis=1)
        result: Bool[ndarray, " n"] = is_far[voxel]
        return result

    @cached_property
    def surface_keys(self) -> Int64[ndarray, " m"]:
        """The keys of the surface's voxels, ascending."""
        near = np.unique((self._inside_keys[:, None] + NEIGHBOUR_OFFSETS).reshape(-1))
        keys: Int64[ndarray, " m"] = near[~_is_member(near, self._outside_keys)]
        return keys

    @cached_property
    def surface_m(self) -> Float32[ndarray, "m 3"]:
        """The centres in the world of the surface's voxels that have votes."""
        return self._grid.centres_m(self._inside_keys)


def _summed(
    keys: Int64[ndarray, " n"], inside: Int64[ndarray, " n"], outside: Int64[ndarray, " n"], voxel_m: float
) -> SurfaceVotes:
    unique, voxel = np.unique(keys, return_inverse=True)
    inside_sums = np.bincount(voxel, weights=inside, minlength=len(unique)).astype(np.int64)
    outside_sums = np.bincount(voxel, weights=outside, minlength=len(unique)).astype(np.int64)
    return SurfaceVotes(unique, inside_sums, outside_sums, voxel_m)


def _is_member(keys: Int64[ndarray, " n"], ascending: Int64[ndarray, " m"]) -> Bool[ndarray, " n"]:
    if len(ascending) == 0:
        return np.zeros(len(keys), np.bool_)
    position = np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)
    result: Bool[ndarray, " n"] = ascending[position] == keys
    return result
