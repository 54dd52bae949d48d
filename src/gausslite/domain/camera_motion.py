"""The camera's motion while one image is exposed: its velocity, the readout time and the exposure time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.trajectory import Twist

MAX_READOUT_S = 0.1
MAX_EXPOSURE_S = 0.1
_MAX_READOUT_SHARE, _MIN_READOUT_FACTOR = 0.65, 0.5
"""Limits as in the rasterizer."""


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
        for name, velocity in (("linear_m_s", self.twist.linear_m_s), ("angular_rad_s", self.twist.angular_rad_s)):
            require_array(f"camera motion {name}", velocity, (3,), np.float64)
            if not np.isfinite(velocity).all():
                raise InvalidInputError(f"camera motion {name}: expected finite values, got {velocity.tolist()}")
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
        readout_factor = np.maximum(1.0 - rows_per_s * self.readout_s / camera.height_px, _MIN_READOUT_FACTOR)
        shares = np.clip((row_shares - 0.5) / readout_factor, -_MAX_READOUT_SHARE, _MAX_READOUT_SHARE)
        result: Float64[ndarray, "n 3"] = points_m + (self.readout_s * shares)[:, None] * velocity
        return result

    @property
    def is_still(self) -> bool:
        """True if the image is that of a camera at rest: no velocity, or neither readout nor exposure time."""
        moves = bool(self.twist.linear_m_s.any() or self.twist.angular_rad_s.any())
        return not moves or (self.readout_s == 0.0 and self.exposure_s == 0.0)
