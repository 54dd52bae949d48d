"""World space in cubes, the unit of the fusion vote and of the uplink (Sec. III-E), and in boxes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt16
from numpy import ndarray

from gausslite.errors import InvalidInputError

_BITS_PER_AXIS = 21
_OFFSET = 1 << (_BITS_PER_AXIS - 1)
_MASK = (1 << _BITS_PER_AXIS) - 1


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """Cubes of size_m metres aligned to the world's origin; keys pack (i, j, k) = floor(p / size) into 63 bits."""

    size_m: float = 0.10

    def __post_init__(self) -> None:
        if not (np.isfinite(self.size_m) and 1e-3 <= self.size_m <= 1e3):
            raise InvalidInputError(f"voxel size_m: expected 0.001 to 1000, got {self.size_m}")

    @property
    def reach_m(self) -> float:
        """Coordinates must stay below this distance from the origin along each axis."""
        return _OFFSET * self.size_m

    def keys(self, points_m: Float32[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
        """The key of the voxel that holds each point. Raises InvalidInputError for points out of reach."""
        # float64: the key must not depend on how a float32 quotient happens to round
        index = np.floor(points_m.astype(np.float64) / self.size_m)
        if not (np.abs(index) < _OFFSET).all():
            raise InvalidInputError(f"points: expected coordinates within ±{self.reach_m:g} m, got one outside")
        ijk = index.astype(np.int64) + _OFFSET
        packed: Int64[ndarray, " n"] = (ijk[:, 0] << (2 * _BITS_PER_AXIS)) | (ijk[:, 1] << _BITS_PER_AXIS) | ijk[:, 2]
        return packed

    def indices(self, keys: Int64[ndarray, " n"]) -> Int64[ndarray, "n 3"]:
        """The (i, j, k) of the voxels with these keys."""
        ijk = np.stack([(keys >> (2 * _BITS_PER_AXIS)) & _MASK, (keys >> _BITS_PER_AXIS) & _MASK, keys & _MASK], axis=1)
        return ijk - _OFFSET

    def short_keys(self, keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"] | UInt16[ndarray, " n"]:
        """Numbers in the order of these keys, in 16 bits where the voxels lie close enough: those sort much faster."""
        if len(keys) == 0:
            return keys
        axes = keys >> (2 * _BITS_PER_AXIS), (keys >> _BITS_PER_AXIS) & _MASK, keys & _MASK
        (first_i, count_i), (first_j, count_j), (first_k, count_k) = (
            (low := int(axis.min()), int(axis.max()) - low + 1) for axis in axes
        )
        if count_i * count_j * count_k > 1 << 16:
            return keys
        i, j, k = axes
        short: UInt16[ndarray, " n"] = (((i - first_i) * count_j + j - first_j) * count_k + k - first_k).astype(
            np.uint16
        )
        return short

    def centres_m(self, keys: Int64[ndarray, " n"]) -> Float32[ndarray, "n 3"]:
        """The centres of the voxels with these keys."""
        return ((self.indices(keys) + 0.5) * self.size_m).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Box:
    """A part of the world, in metres; a voxel belongs to it when its centre does. Raises InvalidInputError."""

    min_m: tuple[float, float, float]
    max_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        corners = np.array([self.min_m, self.max_m])
        if not np.isfinite(corners).all() or not (corners[0] <= corners[1]).all():
            raise InvalidInputError(f"box: expected finite min <= max, got {self.min_m} and {self.max_m}")

    def holds(self, points_m: Float32[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """True for each point in the box; its faces belong to it."""
        low, high = np.array(self.min_m), np.array(self.max_m)
        inside: Bool[ndarray, " n"] = np.logical_and(points_m >= low, points_m <= high).min(axis=1)
        return inside


@dataclass(frozen=True, slots=True)
class AgentStake:
    """One agent's total on one voxel."""

    agent_id: str
    kappa_sum: int
    count: int


@dataclass(frozen=True, slots=True)
class VoxelVotes:
    """The outcome on one voxel: stakes sorted best first; margin is the lead in kappa_sum over the second."""

    key: int
    stakes: tuple[AgentStake, ...]

    @property
    def winner(self) -> str:
        """The agent whose Gaussians the fused map keeps here."""
        return self.stakes[0].agent_id

    @property
    def margin(self) -> int:
        """How much more trained the winner is than the runner-up; its whole sum when uncontested."""
        second = self.stakes[1].kappa_sum if len(self.stakes) > 1 else 0
        return self.stakes[0].kappa_sum - second
