"""Join images of a colour and a depth topic: aligned as recorded, or depth registered to the colour camera here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.datasets.camera_correction import undistort_colour, undistort_depth
from gausslite.datasets.images import RgbdImage
from gausslite.datasets.intrinsics import FolderCamera
from gausslite.datasets.registered_source import register_depth
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.lens import Lens


@dataclass(frozen=True, slots=True, eq=False)
class RgbdCamera:
    """The colour camera, and the depth camera if its images have to be registered.

    depth: None for depth images that are aligned to colour. T_colour_depth: p_colour = T_colour_depth @ p_depth.
    """

    colour: FolderCamera
    depth: FolderCamera | None
    T_colour_depth: Float64[ndarray, "4 4"]

    @classmethod
    def of(
        cls, colour: FolderCamera, depth: FolderCamera | None, T_colour_depth: Float64[ndarray, "4 4"]
    ) -> RgbdCamera:
        """Return the pair; depth with the colour camera's pose, size and intrinsics is aligned. depth None: aligned."""
        same_pose = np.allclose(T_colour_depth, np.eye(4), atol=1e-9)
        if depth is not None and same_pose and depth.camera == colour.camera:
            depth = None
        return cls(colour, depth, T_colour_depth)

    @property
    def camera(self) -> Camera:
        """Camera of the joined images."""
        return self.colour.camera

    @property
    def lens(self) -> Lens | None:
        """Lens of the joined images; None for registered ones, whose colour is undistorted."""
        return self.colour.lens if self.depth is None else None

    def join(self, location: str, rgb: UInt8[ndarray, "h w 3"], depth_m: Float32[ndarray, "hd wd"]) -> RgbdImage:
        """Return both images in the colour camera. Raises DatasetError with the location for images of other sizes."""
        depth_camera = self.colour if self.depth is None else self.depth
        _require_size(f"{location}: colour", rgb, self.camera)
        _require_size(f"{location}: depth", depth_m, depth_camera.camera)
        if self.depth is None:
            return RgbdImage(rgb, depth_m, self.camera)
        if self.colour.lens is not None:
            rgb = undistort_colour(rgb, self.camera, self.colour.lens)
        if self.depth.lens is not None:
            depth_m = undistort_depth(depth_m, self.depth.camera, self.depth.lens)
        return RgbdImage(rgb, register_depth(depth_m, self.depth.camera, self.camera, self.T_colour_depth), self.camera)


def _require_size(location: str, image: ndarray, camera: Camera) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        expected = f"{camera.width_px}x{camera.height_px}"
        raise DatasetError(f"{location}: expected the size of its camera_info, {expected}, got {width}x{height}")
