"""Ground-truth regions of space, and the pixels of a frame that show them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from gausslite.domain.camera import back_project, project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points

_MAX_COORDINATE_M = 1e6
_NEAR_M = 1e-3


@runtime_checkable
class Region(Protocol):
    """A region with an exact mask in any frame."""

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the frame shows the region."""
        ...


@dataclass(frozen=True, slots=True)
class BallRegion:
    """All surface points within radius_m of a world point."""

    centre_m: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        # larger coordinates exceed float32's precision of a metre
        limit_m = _MAX_COORDINATE_M
        if not (max(map(abs, self.centre_m)) <= limit_m and 0 < self.radius_m <= limit_m):
            raise InvalidInputError(
                f"ball: expected a centre within ±{limit_m:g} m and a radius of 0 to {limit_m:g} m, "
                f"got {self.centre_m} and {self.radius_m}"
            )

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the pixel's back-projected point is in the ball."""
        centre = np.asarray(self.centre_m)
        window = _image_window(frame, centre - self.radius_m, centre + self.radius_m)
        offsets = _world_points(frame, window) - centre.astype(np.float32)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[window] = (np.square(offsets).sum(axis=-1) <= self.radius_m**2) & (frame.depth_m[window] > 0)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class VoxelRegion:
    """Surface points in the listed voxels floor(p / size) or their neighbours."""

    voxels: Int64[ndarray, "n 3"]
    size_m: float

    def mask(self, frame: Frame) -> Bool[ndarray, "h w"]:
        """Return True where the pixel's back-projected point is in the listed voxels, dilated by one."""
        low = self.voxels.min(axis=0) - 2
        shape = self.voxels.max(axis=0) + 3 - low
        occupied = np.zeros(shape, np.bool_)
        i, j, k = (self.voxels - low).T
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                for dk in (-1, 0, 1):
                    occupied[i + di, j + dj, k + dk] = True
        window = _image_window(frame, low * self.size_m, (low + shape) * self.size_m)
        index = np.floor(_world_points(frame, window) / np.float32(self.size_m)).astype(np.int64) - low
        inside = ((index >= 0) & (index < shape)).all(axis=-1) & (frame.depth_m[window] > 0)
        result = np.zeros(frame.depth_m.shape, np.bool_)
        result[window][inside] = occupied[tuple(index[inside].T)]
        return result

    @property
    def centroid_m(self) -> Float[ndarray, "3"]:
        """Mean of the listed voxels' centres."""
        centroid: Float[ndarray, "3"] = (self.voxels.mean(axis=0) + 0.5) * self.size_m
        return centroid


def _image_window(frame: Frame, low_m: Float[ndarray, "3"], high_m: Float[ndarray, "3"]) -> tuple[slice, slice]:
    """Return rows and columns of the image that contain all pixels of this box in the world."""
    height, width = frame.depth_m.shape
    bounds_m = np.stack([low_m, high_m]).astype(np.float64)
    p_world = np.stack(np.meshgrid(*bounds_m.T, indexing="ij"), axis=-1).reshape(-1, 3)
    p_camera = transform_points(inverse(frame.T_world_camera), p_world)
    if (p_camera[:, 2] < _NEAR_M).any() or (frame.motion is not None and frame.motion.readout_s != 0.0):
        return slice(0, height), slice(0, width)
    pixels = project(p_camera.astype(np.float32), frame.camera)
    # one more pixel on every side, for rounding
    left, top = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, (width, height)).astype(int).tolist()
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, (width, height)).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _world_points(frame: Frame, window: tuple[slice, slice]) -> Float[ndarray, "h w 3"]:
    rows, columns = window
    points = back_project(frame.depth_m[window], frame.camera, columns.start, rows.start)
    if frame.motion is not None:
        row_shares = (np.arange(rows.start, rows.stop) + 0.5) / frame.camera.height_px
        pixel_shares = np.repeat(row_shares, points.shape[1])
        moved = frame.motion.to_middle_row(points.reshape(-1, 3).astype(np.float64), pixel_shares)
        points = moved.astype(np.float32).reshape(points.shape)
    return transform_points(frame.T_world_camera, points)
