"""The measured surface of an object: voxels that masks of several frames vote inside or outside the object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.voxels import VoxelGrid

_GRID: Final = VoxelGrid(0.025)
_MAX_VOXELS: Final = 60_000


@dataclass(frozen=True, eq=False)
class SurfaceVotes:
    """Votes of voxels of 2.5 cm: in how many frames their visible pixels were inside the object's mask, or outside.

    keys: ascending, without duplicates. An object's surface consists of the voxels with at least as many votes inside
    as outside, and of their neighbours without votes, because depth is inexact. A mask that once spills over to a wall
    is outvoted by the frames that show the wall outside the mask.
    """

    keys: Int64[ndarray, " n"]
    inside: Int64[ndarray, " n"]
    outside: Int64[ndarray, " n"]

    @classmethod
    def empty(cls) -> SurfaceVotes:
        """Return no votes."""
        none = np.zeros(0, np.int64)
        return cls(none, none, none)

    @classmethod
    def from_points(cls, points_m: Float64[ndarray, "n 3"], is_inside: Bool[ndarray, " n"]) -> SurfaceVotes:
        """Return one frame's votes: one for each voxel, by the majority of its points in the world."""
        keys, voxel = np.unique(_GRID.keys(points_m.astype(np.float32)), return_inverse=True)
        total = np.bincount(voxel, minlength=len(keys))
        inside = (2 * np.bincount(voxel, weights=is_inside, minlength=len(keys)) > total).astype(np.int64)
        return cls(keys, inside, 1 - inside)

    def add(self, other: SurfaceVotes) -> SurfaceVotes:
        """Return the sums of both votes; of too many voxels, those with the most votes inside."""
        keys, voxel = np.unique(np.concatenate([self.keys, other.keys]), return_inverse=True)
        inside, outside = (
            np.bincount(voxel, weights=np.concatenate(votes), minlength=len(keys)).astype(np.int64)
            for votes in ((self.inside, other.inside), (self.outside, other.outside))
        )
        if len(keys) > _MAX_VOXELS:
            kept = np.sort(np.argsort(-inside, kind="stable")[:_MAX_VOXELS])
            keys, inside, outside = keys[kept], inside[kept], outside[kept]
        return SurfaceVotes(keys, inside, outside)

    def is_on_surface(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel of the object's surface."""
        return _is_member(_GRID.keys(points_m.astype(np.float32)), self.surface_keys)

    @cached_property
    def _inside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[self.inside >= self.outside]
        return keys

    @cached_property
    def _outside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[self.inside < self.outside]
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
        keys, voxel = np.unique(_GRID.keys(points_m.astype(np.float32)), return_inverse=True)
        is_far = _is_member(keys, own)
        rows = np.flatnonzero(is_far)
        near = (keys[rows, None] + _NEIGHBOUR_OFFSETS).reshape(-1)
        is_far[rows] = ~_is_member(near, others).reshape(len(rows), len(_NEIGHBOUR_OFFSETS)).any(axis=1)
        result: Bool[ndarray, " n"] = is_far[voxel]
        return result

    @cached_property
    def surface_keys(self) -> Int64[ndarray, " m"]:
        """The keys of the surface's voxels, ascending."""
        near = np.unique((self._inside_keys[:, None] + _NEIGHBOUR_OFFSETS).reshape(-1))
        keys: Int64[ndarray, " m"] = near[~_is_member(near, self._outside_keys)]
        return keys

    @cached_property
    def surface_m(self) -> Float32[ndarray, "m 3"]:
        """The centres of the surface's voxels in the world."""
        return _GRID.centres_m(self.surface_keys)


def _neighbour_offsets() -> Int64[ndarray, " 27"]:
    """Return the differences of a voxel's key to those of its 26 neighbours and its own."""
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
    centre = np.full((1, 3), 0.5)
    offsets: Int64[ndarray, " 27"] = _keys(centre + steps) - _keys(centre)
    return offsets


def _keys(voxels: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    return _GRID.keys((_GRID.size_m * voxels).astype(np.float32))


_NEIGHBOUR_OFFSETS: Final = _neighbour_offsets()


def _is_member(keys: Int64[ndarray, " n"], ascending: Int64[ndarray, " m"]) -> Bool[ndarray, " n"]:
    if len(ascending) == 0:
        return np.zeros(len(keys), np.bool_)
    position = np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)
    result: Bool[ndarray, " n"] = ascending[position] == keys
    return result
