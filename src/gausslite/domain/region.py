"""A ground-truth region of space and the pixels of a frame that show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from gausslite.domain.camera import back_project, project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.errors import InvalidInputError

_REACH_M = 1e6
_NEAR_M = 1e-3


@runtime_checkable
class Region(Protocol):
    """Something whose pixels are known for any frame."""

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """True where the frame shows the region."""
        ...


@dataclass(frozen=True, slots=True)
class BallRegion:
    """All surface points within radius_m of a world point."""

    centre_m: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        # beyond, float32 points have no digits left for metres
        if not (max(map(abs, self.centre_m)) <= _REACH_M and 0 < self.radius_m <= _REACH_M):
            raise InvalidInputError(
                f"ball: expected a centre within ±{_REACH_M:g} m and a radius of 0 to {_REACH_M:g} m, "
                f"got {self.centre_m} and {self.radius_m}"
            )

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """True where the pixel's back-projected point lies in the ball."""
        centre = np.asarray(self.centre_m)
        part = _part_that_may_show(frame, centre - self.radius_m, centre + self.radius_m)
        offsets = _world_points(frame, part) - centre.astype(np.float32)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[part] = (np.square(offsets).sum(axis=-1) <= self.radius_m**2) & (frame.depth_m[part] > 0)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class VoxelRegion:
    """Surface points whose voxel floor(p / size) is listed, or touches a listed one."""

    voxels: Int64[ndarray, "n 3"]
    size_m: float

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """True where the pixel's back-projected point falls in a listed voxel, dilated by one."""
        low = self.voxels.min(axis=0) - 2
        shape = self.voxels.max(axis=0) + 3 - low
        occupied = np.zeros(shape, np.bool_)
        i, j, k = (self.voxels - low).T
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                for dk in (-1, 0, 1):
                    occupied[i + di, j + dj, k + dk] = True
        part = _part_that_may_show(frame, low * self.size_m, (low + shape) * self.size_m)
        index = np.floor(_world_points(frame, part) / np.float32(self.size_m)).astype(np.int64) - low
        inside = ((index >= 0) & (index < shape)).all(axis=-1) & (frame.depth_m[part] > 0)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[part][inside] = occupied[tuple(index[inside].T)]
        return result

    @property
    def centroid_m(self) -> Float[ndarray, "3"]:
        """Mean of the listed voxels' centres."""
        centroid: Float[ndarray, "3"] = (self.voxels.mean(axis=0) + 0.5) * self.size_m
        return centroid


def _part_that_may_show(frame: Frame, low_m: Float[ndarray, "3"], high_m: Float[ndarray, "3"]) -> tuple[slice, slice]:
    """The rows and columns of the image outside of which no surface point lies in this box of the world."""
    height, width = frame.depth_m.shape
    ends = np.stack([low_m, high_m]).astype(np.float64)
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = transform_points(inverse(frame.T_world_camera), corners)
    if (seen[:, 2] < _NEAR_M).any():
        return slice(0, height), slice(0, width)
    pixels = project(seen.astype(np.float32), frame.camera)
    # a pixel more on every side, for what rounding may do
    left, top = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, (width, height)).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (width, height)).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _world_points(frame: Frame, part: tuple[slice, slice]) -> Float[ndarray, "h w 3"]:
    rows, columns = part
    points = back_project(frame.depth_m[part], frame.camera, columns.start, rows.start)
    return transform_points(frame.T_world_camera, points)
