"""The pinhole camera model: back-projection of pixels and projection of points.

Pixel (column u, row v) has its centre at (u + 0.5, v + 0.5). If a dataset's principal point assumes integer pixel
centres, its reader adds 0.5 to cx and cy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.arguments import require_whole
from gausslite.domain.errors import InvalidInputError

_MAX_SIDE_PX = 16384
_MAX_FOCAL_PX = 1e6
"""Larger focal lengths overflow float32 in products with pixels; real cameras have a hundredth of it."""
_MAX_SLOPE = 100.0
"""Largest tangent of a ray's angle to the optical axis (89.4 degrees); steeper rays are not a pinhole camera."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics in pixels; the image plane's origin is the top-left corner of the top-left pixel."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        for name in ("fx_px", "fy_px"):
            value = getattr(self, name)
            if not 0 < value <= _MAX_FOCAL_PX:
                raise InvalidInputError(
                    f"camera {name}: expected a positive number up to {_MAX_FOCAL_PX:g}, got {value}"
                )
        for name in ("cx_px", "cy_px"):
            value = getattr(self, name)
            if not np.isfinite(value):
                raise InvalidInputError(f"camera {name}: expected a finite number, got {value}")
        for name in ("width_px", "height_px"):
            value = getattr(self, name)
            require_whole(f"camera {name}", value)
            if not 1 <= value <= _MAX_SIDE_PX:
                raise InvalidInputError(f"camera {name}: expected 1 to {_MAX_SIDE_PX}, got {value}")
        for axis, side_px in (("x", self.width_px), ("y", self.height_px)):
            focal_px, centre_px = getattr(self, f"f{axis}_px"), getattr(self, f"c{axis}_px")
            if max(abs(centre_px), abs(side_px - centre_px)) > _MAX_SLOPE * focal_px:
                raise InvalidInputError(
                    f"camera f{axis}_px: expected rays within a slope of {_MAX_SLOPE:g}, "
                    f"got {focal_px} with c{axis}_px {centre_px} and {side_px} pixels"
                )

    def resized(self, width_px: int, height_px: int) -> Camera:
        """Return the camera for an image scaled to this size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Camera(self.fx_px * sx, self.fy_px * sy, self.cx_px * sx, self.cy_px * sy, width_px, height_px)


def back_project(
    depth_m: Float32[ndarray, "h w"], camera: Camera, left_px: int = 0, top_px: int = 0
) -> Float32[ndarray, "h w 3"]:
    """Lift every pixel to a point in the camera frame (OpenCV axes); depth 0 gives the origin.

    left_px and top_px: offset of `depth_m` in the camera's image, if it is a crop.
    """
    height, width = depth_m.shape
    columns, rows = np.arange(left_px, left_px + width), np.arange(top_px, top_px + height)
    x = ((columns.astype(np.float32) + 0.5) - np.float32(camera.cx_px)) / np.float32(camera.fx_px)
    y = ((rows.astype(np.float32) + 0.5) - np.float32(camera.cy_px)) / np.float32(camera.fy_px)
    points = np.empty((height, width, 3), np.float32)
    points[..., 0] = x[None, :] * depth_m
    points[..., 1] = y[:, None] * depth_m
    points[..., 2] = depth_m
    return points


def lift(
    pixels_px: Float64[ndarray, "n 2"], depths_m: Float64[ndarray, " n"], camera: Camera
) -> Float64[ndarray, "n 3"]:
    """Return camera-frame points at image coordinates (column, row) and depths; pixel centres are at +0.5."""
    principal_px, focal_px = np.array([camera.cx_px, camera.cy_px]), np.array([camera.fx_px, camera.fy_px])
    rays = (pixels_px - principal_px) / focal_px
    return np.concatenate([rays * depths_m[:, None], depths_m[:, None]], axis=1)


def project(points_camera: Float32[ndarray, "n 3"], camera: Camera) -> Float32[ndarray, "n 2"]:
    """Project camera-frame points with z > 0 to image coordinates (column, row) in pixels."""
    inverse_z = 1.0 / points_camera[:, 2]
    return np.stack(
        [
            points_camera[:, 0] * inverse_z * camera.fx_px + camera.cx_px,
            points_camera[:, 1] * inverse_z * camera.fy_px + camera.cy_px,
        ],
        axis=1,
    ).astype(np.float32)
