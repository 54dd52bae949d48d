"""The colour camera to which depth images are registered, for sensors with two separate cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, FileIntrinsics
from gausslite.domain.errors import InvalidInputError

_MAX_BASELINE_M = 1.0
_MAX_ROTATION_DEG = 45.0


@dataclass(frozen=True, slots=True)
class DepthRegistration:
    """The colour camera's intrinsics and T_colour_depth, for two cameras with about the same viewing direction.

    intrinsics: in the data set's convention (pixel centres at integers), for images of the sequence's own size.
    offset_m: translation of T_colour_depth, the depth camera's position in the colour camera's frame. rotation_deg:
    rotation vector of T_colour_depth (axis times angle). Raises InvalidInputError.
    """

    intrinsics: FileIntrinsics
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        fx, fy, cx, cy = self.intrinsics.fx, self.intrinsics.fy, self.intrinsics.cx, self.intrinsics.cy
        if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx <= 0 or fy <= 0:
            given = f"{fx:g},{fy:g},{cx:g},{cy:g}"
            raise InvalidInputError(
                f"depth registration: expected finite FX,FY,CX,CY with focal lengths above 0, got {given}"
            )
        if not all(abs(value) <= _MAX_BASELINE_M for value in self.offset_m):
            given = ",".join(f"{value:g}" for value in self.offset_m)
            raise InvalidInputError(
                f"depth registration: expected TX,TY,TZ in metres, at most {_MAX_BASELINE_M:g} each, got {given}"
            )
        if not math.hypot(*self.rotation_deg) <= _MAX_ROTATION_DEG:
            given = ",".join(f"{value:g}" for value in self.rotation_deg)
            raise InvalidInputError(
                f"depth registration: expected RX,RY,RZ of at most {_MAX_ROTATION_DEG:g} degrees in all, got {given}"
            )

    @classmethod
    def parse(cls, text: str) -> DepthRegistration:
        """Return the registration of FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]] in pixels, metres, degrees.

        Raises InvalidInputError.
        """
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (4, 7, 10):
            raise InvalidInputError(f"depth registration: expected FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]], got {text!r}")
        x, y, z, *rotation = (*values[4:], *(0.0,) * (10 - len(values)))
        return cls(FileIntrinsics(*values[:4]), (x, y, z), (rotation[0], rotation[1], rotation[2]))

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        k = self.intrinsics
        return ",".join(f"{value:.10g}" for value in (k.fx, k.fy, k.cx, k.cy, *self.offset_m, *self.rotation_deg))

    def extrinsics(self) -> Float64[ndarray, "4 4"]:
        """Return T_colour_depth: p_colour = T_colour_depth @ p_depth."""
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.radians(self.rotation_deg))[0]
        T[:3, 3] = self.offset_m
        return T

    def scaled(self, x_factor: float, y_factor: float) -> DepthRegistration:
        """Return the registration for images larger by these factors."""
        return replace(self, intrinsics=self.intrinsics.scaled(x_factor, y_factor))

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Return the colour camera (pixel centres at +0.5)."""
        return self.intrinsics.camera("depth registration", width_px, height_px)
