"""Warp a frame into the view of another one, by the recorded depth and both poses."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.calibration.alignment import MAX_RELATIVE_DEPTH_ERROR
from gausslite.datasets.registered_source import register_depth
from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.render.rasterizer import NEAR_M, Rendering


@dataclass(frozen=True, slots=True, eq=False)
class FrameWarp:
    """For every pixel of a view: the pixel of a frame that shows the same surface, and the surface's depth in the view.

    columns, rows: counted from pixel centres at integers. alpha: 1 where the frame shows the surface, else 0.
    """

    columns: Float32[ndarray, "h w"]
    rows: Float32[ndarray, "h w"]
    depth_m: Float32[ndarray, "h w"]
    alpha: Float32[ndarray, "h w"]

    @classmethod
    def of(cls, frame: Frame, other: Frame) -> FrameWarp:
        """Return the warp of the frame into the other's view."""
        T_other_frame = inverse(other.T_world_camera) @ frame.T_world_camera
        depth_m = register_depth(frame.depth_m, frame.camera, other.camera, T_other_frame)
        points = transform_points(inverse(T_other_frame), back_project(depth_m, other.camera).reshape(-1, 3))
        z_m = np.maximum(points[:, 2], NEAR_M)
        # pixel centres at integers, as in cv2.remap
        columns, rows = (axis - 0.5 for axis in frame.camera.pixels(points[:, 0] / z_m, points[:, 1] / z_m))
        columns, rows, z_m = (values.reshape(depth_m.shape) for values in (columns, rows, z_m))
        depth_error_m = np.abs(cv2.remap(frame.depth_m, columns, rows, cv2.INTER_NEAREST) - z_m)
        alpha = ((depth_m > 0) & (depth_error_m < MAX_RELATIVE_DEPTH_ERROR * depth_m)).astype(np.float32)
        return cls(columns, rows, depth_m * alpha, alpha)

    def apply(self, image: ndarray) -> ndarray:
        """Return an image of the frame as the view shows it."""
        return cv2.remap(image, self.columns, self.rows, cv2.INTER_LINEAR)

    def rendering(self, frame: Frame) -> Rendering:
        """Return the frame as the view shows it, as a map would be rendered there."""
        rgb = self.apply(frame.rgb).astype(np.float32) / np.float32(255.0)
        return Rendering(rgb, self.depth_m, self.alpha, None)


def warp_into(frame: Frame, other: Frame) -> Rendering:
    """Return the frame as the other's camera would see it."""
    return FrameWarp.of(frame, other).rendering(frame)
