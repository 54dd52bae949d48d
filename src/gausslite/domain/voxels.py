"""The voxel grid, unit of the fusion vote and the uplink (Sec. III-E), boxes, and the votes of a voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError

MIN_VOXEL_M, MAX_VOXEL_M = 0.001, 1000.0
_BITS_PER_AXIS = 21
_OFFSET = 1 << (_BITS_PER_AXIS - 1)
_MASK = (1 << _BITS_PER_AXIS) - 1
TILE_VOXELS = 16
"""Voxels of a tile along each axis."""
_TILE_MASK = sum((_MASK - (TILE_VOXELS - 1)) << (axis * _BITS_PER_AXIS) for axis in range(3))


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
        ijk = np.stack([(keys >> (2 * _BITS_PER_AXIS)) & _MASK, (keys >> _BITS_PER_AXIS) & _MASK, keys & _MASK], axis=1)
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
    packed: Int64[ndarray, " n"] = (i << (2 * _BITS_PER_AXIS)) | (j << _BITS_PER_AXIS) | k
    return packed


@dataclass(frozen=True, slots=True)
class AxisAlignedBox:
    """A box in the world, in metres; a voxel belongs to it if its centre does. Raises InvalidInputError."""

    min_m: tuple[float, float, float]
    max_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        corners = np.array([self.min_m, self.max_m])
        if not np.isfinite(corners).all() or not (corners[0] <= corners[1]).all():
            raise InvalidInputError(f"box: expected finite min <= max, got {self.min_m} and {self.max_m}")

    def contains(self, points_m: Float32[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for each point in the box or on its faces."""
        low, high = np.array(self.min_m), np.array(self.max_m)
        inside: Bool[ndarray, " n"] = np.logical_and(points_m >= low, points_m <= high).min(axis=1)
        return inside


@dataclass(frozen=True, slots=True)
class VoxelScore:
    """One agent's kappa sum and number of Gaussians in one voxel."""

    agent_id: str
    kappa_sum: int
    count: int


@dataclass(frozen=True, slots=True)
class VoxelVotes:
    """The vote of one voxel: scores sorted best first."""

    key: int
    scores: tuple[VoxelScore, ...]

    @property
    def winner(self) -> str:
        """The agent whose Gaussians the fused map contains in this voxel."""
        return self.scores[0].agent_id

    @property
    def margin(self) -> int:
        """The winner's lead in kappa_sum over the second; its own kappa_sum without a second agent."""
        second = self.scores[1].kappa_sum if len(self.scores) > 1 else 0
        return self.scores[0].kappa_sum - second
