"""Propagate detections from a keyframe to later frames: project their 3D frustum and mask it by depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project, lift, project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.relevance import Detection

_NEAR_PERCENTILE: Final = 5
_FAR_PERCENTILE: Final = 95
_MIN_PIXELS: Final = 8
_MIN_Z_M: Final = 0.05
_SLACK_M: Final = 0.02
_SLACK_SHARE: Final = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Frustum:
    """A detection's box between the nearest and farthest depth of its mask, with the detecting camera.

    missed_detections: later detections that did not find the object again.
    """

    detection: Detection
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    near_m: float
    far_m: float
    missed_detections: int = 0

    def corners_m(self) -> Float64[ndarray, "8 3"]:
        """Return the frustum's corners in the world: the near face first, then the far one."""
        left, top, right, bottom = self.detection.box_px
        corners_px = np.array([(left, top), (right, top), (right, bottom), (left, bottom)] * 2, np.float64)
        depths_m = np.repeat(np.array([self.near_m, self.far_m]), 4)
        return transform_points(self.T_world_camera, lift(corners_px, depths_m, self.camera))


def lift_frustum(detection: Detection, depth_m: Float32[ndarray, "h w"], frame: Frame) -> Frustum | None:
    """Lift a detection of this frame; None if too few of its mask's pixels have depth."""
    depths = depth_m[detection.mask & (depth_m > 0)]
    if len(depths) < _MIN_PIXELS:
        return None
    near_m, far_m = (float(value) for value in np.percentile(depths, (_NEAR_PERCENTILE, _FAR_PERCENTILE)))
    slack_m = _SLACK_M + _SLACK_SHARE * far_m
    return Frustum(detection, frame.camera, frame.T_world_camera, max(near_m - slack_m, _MIN_Z_M), far_m + slack_m)


def reprojected_box_px(frustum: Frustum, frame: Frame) -> tuple[float, float, float, float] | None:
    """Return the bounding box of the frustum in another frame, clipped to the image; None if it is out of view."""
    corners = transform_points(inverse(frame.T_world_camera), frustum.corners_m())
    in_front = corners[corners[:, 2] > _MIN_Z_M].astype(np.float32)
    if len(in_front) == 0:
        return None
    pixels = project(in_front, frame.camera)
    size = (frame.camera.width_px, frame.camera.height_px)
    left, top = (float(value) for value in np.clip(pixels.min(axis=0), 0, size))
    right, bottom = (float(value) for value in np.clip(pixels.max(axis=0), 0, size))
    if right - left < 1 or bottom - top < 1:
        return None
    return left, top, right, bottom


def mask_in_frustum(frustum: Frustum, box_px: tuple[float, float, float, float], frame: Frame) -> Bool[ndarray, "h w"]:
    """Return the box's pixels whose surface points lie in the frustum and project into the keyframe's mask."""
    left, top = (int(np.floor(value)) for value in box_px[:2])
    right, bottom = (int(np.ceil(value)) for value in box_px[2:])
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    depth_m = frame.depth_m[top:bottom, left:right]
    T_key_camera = inverse(frustum.T_world_camera) @ frame.T_world_camera
    points = transform_points(T_key_camera, back_project(depth_m, frame.camera, left, top)).reshape(-1, 3)
    between = (points[:, 2] >= frustum.near_m) & (points[:, 2] <= frustum.far_m) & (depth_m.reshape(-1) > 0)
    selected = np.flatnonzero(between)
    pixels = np.floor(project(points[selected], frustum.camera)).astype(np.int64)
    size = np.asarray((frustum.camera.width_px, frustum.camera.height_px))
    visible = ((pixels >= 0) & (pixels < size)).all(axis=1)
    selected, pixels = selected[visible], pixels[visible]
    inside = np.zeros(depth_m.size, np.bool_)
    inside[selected] = frustum.detection.mask[pixels[:, 1], pixels[:, 0]]
    mask[top:bottom, left:right] = inside.reshape(depth_m.shape)
    return mask
