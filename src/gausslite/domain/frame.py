"""One posed RGB-D image, validated on construction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.arguments import require_whole
from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import InvalidInputError, PoseError
from gausslite.domain.pose import require_rigid

MAX_COORDINATE_M = 10_000.0
"""Farther from the world's origin, float32 no longer resolves a millimetre, and voxel keys overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A colour and depth image with its camera and pose.

    depth_m is the distance along the optical axis in metres, 0 where the sensor had no return.
    T_world_camera uses OpenCV axes (x right, y down, z forward); its position is within 10 km of the world's origin
    along each axis. motion: the camera's motion while the image was exposed, with T_world_camera the pose at the middle
    row's time; None for an image of a camera at rest. recorded_rgb: the same image before it was made smaller, for
    detectors; None if it never was. Raises ShapeError, PoseError, InvalidInputError.
    """

    index: int
    capture_time_ns: int
    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    motion: CameraMotion | None = None
    recorded_rgb: UInt8[ndarray, "hr wr 3"] | None = None

    def __post_init__(self) -> None:
        require_whole("frame index", self.index)
        require_whole("frame capture_time_ns", self.capture_time_ns)
        size = (self.camera.height_px, self.camera.width_px)
        require_array("frame rgb", self.rgb, (*size, 3), np.uint8)
        require_array("frame depth_m", self.depth_m, size, np.float32)
        require_array("frame T_world_camera", self.T_world_camera, (4, 4), np.float64)
        require_rigid("frame T_world_camera", self.T_world_camera)
        if np.abs(self.T_world_camera[:3, 3]).max() > MAX_COORDINATE_M:
            raise PoseError(
                f"frame T_world_camera: expected a camera within {MAX_COORDINATE_M:g} m of the world's origin, "
                f"got one at {self.T_world_camera[:3, 3].tolist()}; choose an origin near the robot"
            )
        if not np.isfinite(self.depth_m).all() or (self.depth_m < 0).any():
            raise InvalidInputError("frame depth_m: expected finite values of at least 0 (0 = no return)")

    @property
    def sharpest_rgb(self) -> UInt8[ndarray, "hs ws 3"]:
        """The image with the most pixels: as recorded if it was made smaller."""
        return self.rgb if self.recorded_rgb is None else self.recorded_rgb

    @property
    def has_depth(self) -> bool:
        """False if no pixel has a depth; such a frame cannot be mapped."""
        return bool((self.depth_m > 0).any())
