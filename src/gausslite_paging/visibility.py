"""Which boxes of space a camera may see, and how far away they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.render.rasterizer import NEAR_M

_MARGIN = 0.1
"""Of the image's size, on each side: for the motion during an exposure, and for refined poses."""


@dataclass(frozen=True, slots=True, eq=False)
class Frustum:
    """What a camera may see: points p with normals · p + offsets >= 0, up to a distance."""

    normals: Float64[ndarray, "5 3"]
    offsets: Float64[ndarray, "5"]
    eye_m: Float64[ndarray, "3"]
    reach_m: float

    @classmethod
    def of(cls, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], reach_m: float) -> Frustum:
        """Return the view of a camera that sees nothing beyond reach_m."""
        x_px, y_px = _MARGIN * camera.width_px, _MARGIN * camera.height_px
        left, top = camera.slopes(-x_px, -y_px)
        right, bottom = camera.slopes(camera.width_px + x_px, camera.height_px + y_px)
        planes = np.array([[0, 0, 1], [1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]], np.float64)
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        eye_m = T_world_camera[:3, 3]
        normals = planes @ T_world_camera[:3, :3].T
        offsets = -normals @ eye_m
        offsets[0] -= NEAR_M
        return cls(normals, offsets, eye_m, reach_m)

    def distances_m(self, low_m: Float64[ndarray, "n 3"], high_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return how far each box is from the eye; infinity for one that the camera cannot see."""
        seen = np.ones(len(low_m), np.bool_)
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            # the corner that is farthest inside
            seen &= np.where(normal > 0, high_m, low_m) @ normal + offset >= 0
        away_m = distances_m(self.eye_m, low_m, high_m)
        return np.where(seen & (away_m <= self.reach_m), away_m, np.inf)

    def sees(self, bounds_m: Float64[ndarray, "n 2 3"]) -> Bool[ndarray, " n"]:
        """Return which boxes, given by their corners, the camera may see."""
        seen: Bool[ndarray, " n"] = np.isfinite(self.distances_m(bounds_m[:, 0], bounds_m[:, 1]))
        return seen


def distances_m(
    point_m: Float64[ndarray, "3"], low_m: Float64[ndarray, "n 3"], high_m: Float64[ndarray, "n 3"]
) -> Float64[ndarray, " n"]:
    """Return the distance of a point from each box, 0 inside."""
    away: Float64[ndarray, " n"] = np.linalg.norm(np.clip(point_m, low_m, high_m) - point_m, axis=1)
    return away
