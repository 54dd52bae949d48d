"""The pinhole camera model: projection, back-projection, rays, crops and sizes, for all modules but the rasterizers.

Pixel (column u, row v) has its centre at (u + 0.5, v + 0.5). If a dataset's principal point assumes integer pixel
centres, its reader adds 0.5 to cx and cy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.checks import require_number, require_types, require_whole
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.pose import Twist

Value = TypeVar("Value", float, ndarray)
_MAX_SIDE_PX = 16384
_MAX_FOCAL_PX = 1e6
"""Larger focal lengths overflow float32 in products with pixels; real cameras have a hundredth of it."""
_MAX_SLOPE = 100.0
"""Largest tangent of a ray's angle to the optical axis (89.4 degrees); steeper rays are not a pinhole camera."""
MAX_READOUT_S = 0.1
MAX_EXPOSURE_S = 0.1
MAX_READOUT_SHARE, MIN_ROW_RATE = 0.65, 0.5
"""Limits of a moving camera's exposure time, in readouts, and of 1 - s readout / height (render.rasterizer)."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics in pixels; the image plane's origin is the top-left corner of the top-left pixel."""

    fx_px: float  # focal length in image columns
    fy_px: float  # focal length in image rows
    cx_px: float  # column of the principal point; the first pixel's centre is at 0.5
    cy_px: float  # its row
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
            value, is_focal = getattr(self, name), name.startswith("f")
            require_number(f"camera {name}", value)
            if not (0 < value <= _MAX_FOCAL_PX if is_focal else math.isfinite(value)):
                expected = f"a positive number up to {_MAX_FOCAL_PX:g}" if is_focal else "a finite number"
                raise InvalidInputError(f"camera {name}: expected {expected}, got {value}")
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

    @classmethod
    def centred(cls, focal_px: float, width_px: int, height_px: int) -> Camera:
        """Return the camera with square pixels and the principal point in the middle of the image."""
        return cls(focal_px, focal_px, width_px / 2, height_px / 2, width_px, height_px)

    @property
    def opencv_matrix(self) -> Float64[ndarray, "3 3"]:
        """The matrix K of OpenCV, whose pixel centres lie at integers."""
        return np.array([[self.fx_px, 0, self.cx_px - 0.5], [0, self.fy_px, self.cy_px - 0.5], [0, 0, 1]])

    def with_opencv_matrix(self, K: Float64[ndarray, "3 3"]) -> Camera:
        """Return the camera of the same image size with this matrix K of OpenCV."""
        fx_px, fy_px, cx_px, cy_px = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return replace(self, fx_px=fx_px, fy_px=fy_px, cx_px=cx_px + 0.5, cy_px=cy_px + 0.5)

    def resized(self, width_px: int, height_px: int) -> Camera:
        """Return the camera for an image scaled to this size."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Camera(self.fx_px * sx, self.fy_px * sy, self.cx_px * sx, self.cy_px * sy, width_px, height_px)

    def narrower(self, width_px: int) -> Camera:
        """Return the camera of the same image in a width of at most width_px."""
        width_px = min(width_px, self.width_px)
        return self.resized(width_px, max(round(self.height_px * width_px / self.width_px), 1))

    def cropped(self, left_px: int, top_px: int, width_px: int, height_px: int) -> Camera:
        """Return the camera for the part of the image of this size that begins at this column and row."""
        return Camera(self.fx_px, self.fy_px, self.cx_px - left_px, self.cy_px - top_px, width_px, height_px)

    def zoomed(self, factor: float) -> Camera:
        """Return the camera with its focal lengths multiplied, about the principal point."""
        return replace(self, fx_px=self.fx_px * factor, fy_px=self.fy_px * factor)

    def mirrored(self) -> Camera:
        """Return the camera for the image in which left and right have changed places."""
        return replace(self, cx_px=self.width_px - self.cx_px)

    def magnification(self, other: Camera) -> tuple[float, float]:
        """Return how many times more columns and rows than the other camera this one shows the same angle with."""
        return self.fx_px / other.fx_px, self.fy_px / other.fy_px

    def pixels(self, x: Value, y: Value) -> tuple[Value, Value]:
        """Return the image coordinates (columns, rows) of rays of slopes x and y, X / Z and Y / Z; keeps the dtype."""
        return x * self.fx_px + self.cx_px, y * self.fy_px + self.cy_px

    def slopes(self, columns: Value, rows: Value) -> tuple[Value, Value]:
        """Return the slopes of the rays through these image coordinates: the inverse of `pixels`."""
        return (columns - self.cx_px) / self.fx_px, (rows - self.cy_px) / self.fy_px

    def pixels_per_s(self, x: ndarray, y: ndarray, rate: Float64[ndarray, "*n 3"]) -> tuple[ndarray, ndarray]:
        """Return the image velocity of points at slopes x and y; rate: their velocity divided by their depth."""
        return self.fx_px * (rate[..., 0] - x * rate[..., 2]), self.fy_px * (rate[..., 1] - y * rate[..., 2])

    def gradient_by_point(
        self, by_column: ndarray, by_row: ndarray, points: Float64[ndarray, "n 3"]
    ) -> tuple[ndarray, ndarray, ndarray]:
        """Return the gradient by X, Y and Z of points, from that of the image at their pixels."""
        x, y, z = points.T
        by_x, by_y = by_column * self.fx_px / z, by_row * self.fy_px / z
        return by_x, by_y, -(by_x * x + by_y * y) / z

    def length_m(self, length_px: Value | float, depth_m: Value) -> Value:
        """Return the length in metres that covers this many pixels of a row at this depth."""
        return length_px * depth_m / self.fx_px

    def length_px(self, length_m: float, depth_m: Value) -> Value:
        """Return the most pixels that a length parallel to the image covers at this depth."""
        return max(self.fx_px, self.fy_px) * length_m / depth_m

    def angle_px(self, angle_rad: float) -> float:
        """Return the pixels of a row that a small angle covers near the principal point."""
        return self.fx_px * angle_rad

    def unit_depth_size(self, width_px: float, height_px: float) -> tuple[float, float]:
        """Return the size of a part of the image, divided by the depth of what it shows."""
        return width_px / self.fx_px, height_px / self.fy_px

    @property
    def vertical_fov_rad(self) -> float:
        """The vertical field of view."""
        return float(2 * np.arctan(self.height_px / (2 * self.fy_px)))


@dataclass(frozen=True, slots=True)
class FileIntrinsics:
    """Focal lengths and principal point in pixels, in the data set's convention (pixel centres at integers)."""

    fx: float
    fy: float
    cx: float
    cy: float

    def camera(self, place: str, width_px: int, height_px: int) -> Camera:
        """Return the Camera, with 0.5 px added to the principal point. Raises DatasetError with the place."""
        try:
            return Camera(self.fx, self.fy, self.cx + 0.5, self.cy + 0.5, width_px, height_px)
        except InvalidInputError as error:
            raise DatasetError(f"{place}: {error}") from None

    def scaled(self, x_factor: float, y_factor: float) -> FileIntrinsics:
        """Return the intrinsics for images larger by these factors."""
        cx, cy = (self.cx + 0.5) * x_factor - 0.5, (self.cy + 0.5) * y_factor - 0.5
        return FileIntrinsics(self.fx * x_factor, self.fy * y_factor, cx, cy)


def back_project(
    depth_m: Float32[ndarray, "h w"], camera: Camera, left_px: int = 0, top_px: int = 0
) -> Float32[ndarray, "h w 3"]:
    """Lift every pixel to a point in the camera frame (OpenCV axes); depth 0 gives the origin.

    left_px and top_px: offset of `depth_m` in the camera's image, if it is a crop.
    """
    height, width = depth_m.shape
    columns, rows = np.arange(left_px, left_px + width), np.arange(top_px, top_px + height)
    x, y = camera.slopes(columns.astype(np.float32) + np.float32(0.5), rows.astype(np.float32) + np.float32(0.5))
    points = np.empty((height, width, 3), np.float32)
    points[..., 0] = x[None, :] * depth_m
    points[..., 1] = y[:, None] * depth_m
    points[..., 2] = depth_m
    return points


def lift(pixels_px: Float[ndarray, "n 2"], depths_m: Float[ndarray, " n"], camera: Camera) -> Float[ndarray, "n 3"]:
    """Return camera-frame points at image coordinates (column, row) and depths; pixel centres are at +0.5."""
    x, y = camera.slopes(pixels_px[:, 0], pixels_px[:, 1])
    return np.stack([x * depths_m, y * depths_m, depths_m], axis=1)


def project(points_camera: Float32[ndarray, "n 3"], camera: Camera) -> Float32[ndarray, "n 2"]:
    """Project camera-frame points with z > 0 to image coordinates (column, row) in pixels."""
    inverse_z = 1.0 / points_camera[:, 2]
    columns, rows = camera.pixels(points_camera[:, 0] * inverse_z, points_camera[:, 1] * inverse_z)
    return np.stack([columns, rows], axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """How a camera moves while its rows are exposed, one after the other from the first to the last.

    twist: velocity in the camera's axes at the middle row's time, which is the time of the image's pose. readout_s:
    time from the first row's exposure to the last row's; negative if rows are read from the bottom; 0 for a global
    shutter. exposure_s: duration of each row's exposure, centred on the row's time. Raises ShapeError,
    InvalidInputError.
    """

    twist: Twist
    readout_s: float = 0.0
    exposure_s: float = 0.0

    def __post_init__(self) -> None:
        require_types(twist=(self.twist, Twist))
        for name, velocity in (("linear_m_s", self.twist.linear_m_s), ("angular_rad_s", self.twist.angular_rad_s)):
            require_array(f"camera motion {name}", velocity, (3,), np.float64)
            if not np.isfinite(velocity).all():
                raise InvalidInputError(f"camera motion {name}: expected finite values, got {velocity.tolist()}")
        require_number("camera motion readout_s", self.readout_s)
        require_number("camera motion exposure_s", self.exposure_s)
        if not (math.isfinite(self.readout_s) and abs(self.readout_s) <= MAX_READOUT_S):
            raise InvalidInputError(
                f"camera motion readout_s: expected -{MAX_READOUT_S:g} to {MAX_READOUT_S:g}, got {self.readout_s}"
            )
        if not 0.0 <= self.exposure_s <= MAX_EXPOSURE_S:
            raise InvalidInputError(
                f"camera motion exposure_s: expected 0 to {MAX_EXPOSURE_S:g}, got {self.exposure_s}"
            )

    def to_middle_row(
        self, points_m: Float64[ndarray, "n 3"], row_shares: Float64[ndarray, " n"]
    ) -> Float64[ndarray, "n 3"]:
        """Return points seen by a row of the image, in the frame of the camera at the middle row's time.

        points_m: in the camera frame at the time of their row. row_shares: their rows, from 0 (top) to 1 (bottom).
        """
        time_s = (self.readout_s * (row_shares - 0.5))[:, None]
        turned_m = np.cross(self.twist.angular_rad_s, points_m)
        second_order_m = np.cross(self.twist.angular_rad_s, turned_m)
        result: Float64[ndarray, "n 3"] = (
            points_m + time_s * (self.twist.linear_m_s + turned_m) + 0.5 * time_s**2 * second_order_m
        )
        return result

    def at_exposure(self, points_m: Float64[ndarray, "n 3"], camera: Camera) -> Float64[ndarray, "n 3"]:
        """Return points of the camera frame at the middle row's time at the times when their rows are exposed.

        points_m: in front of the camera. The same first-order model as in the rasterizer (render/rasterizer.py).
        """
        velocity = -(self.twist.linear_m_s + np.cross(self.twist.angular_rad_s, points_m))
        tangent = points_m[:, 1] / points_m[:, 2]
        rows_per_s = camera.fy_px * (velocity[:, 1] - tangent * velocity[:, 2]) / points_m[:, 2]
        row_shares = (camera.fy_px * tangent + camera.cy_px) / camera.height_px
        readout_factor = np.maximum(1.0 - rows_per_s * self.readout_s / camera.height_px, MIN_ROW_RATE)
        shares = np.clip((row_shares - 0.5) / readout_factor, -MAX_READOUT_SHARE, MAX_READOUT_SHARE)
        result: Float64[ndarray, "n 3"] = points_m + (self.readout_s * shares)[:, None] * velocity
        return result

    @property
    def is_still(self) -> bool:
        """True if the image is that of a camera at rest: no velocity, or neither readout nor exposure time."""
        moves = bool(self.twist.linear_m_s.any() or self.twist.angular_rad_s.any())
        return not moves or (self.readout_s == 0.0 and self.exposure_s == 0.0)
