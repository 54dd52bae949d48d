"""Does an image show what the map and the latest keyframes show from its pose? Yes, no, or it cannot be said.

Two observations together contradict: depth and texture fit the rendering nowhere, and the camera sees a surface where
an earlier frame saw free space, or sees through one of the map. A place that was not mapped does neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.mapping.free_space import DepthView
from gausslite.render.rasterizer import Rendering
from gausslite_places.verification import blurred_luminance, reduced, texture_correlation

_WIDTH_PX, _POINT_STEP = 160, 2
_OPAQUE_ALPHA, _MIN_COVERED = 0.7, 0.3
_DEPTH_SHARE = 0.1
_THROUGH_M, _THROUGH_SHARE = 0.1, 0.05
_AROUND = np.ones((3, 3), np.uint8)
_MIN_DEPTH, _MIN_TEXTURE = 0.65, 0.5
_MAX_TEXTURE, _MIN_CONTRADICTED = 0.4, 0.1
"""At their own poses, images of the kitchen of 7-Scenes, of a HoloLens kitchenette and of a simulated home have depths
of 0.77 and textures of 0.59 at least; at poses more than 0.5 m or 25 degrees away, 0.58 and 0.32 at most."""


class Agreement(Enum):
    """How an image compares with what its pose should show."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNKNOWN = "unknown"


def compare(
    frame: Frame, rendered: Rendering | None, earlier: Sequence[Frame], only_contradiction: bool = False
) -> Agreement:
    """Compare a frame with the map rendered from its pose and with earlier frames; unknown without a rendering.

    only_contradiction: agreement is not asked for; it may be unknown, in a third of the time.
    """
    if rendered is None:
        return Agreement.UNKNOWN
    camera = frame.camera.narrower(_WIDTH_PX)
    depth_m, alpha, map_m = (
        _reduced_image(image, camera) for image in (frame.depth_m, rendered.alpha, rendered.expected_depth_m())
    )
    measured = depth_m > 0
    covered = measured & (alpha > _OPAQUE_ALPHA)
    measured_px, covered_px = int(np.count_nonzero(measured)), int(np.count_nonzero(covered))
    if covered_px < _MIN_COVERED * measured_px or covered_px == 0:
        return Agreement.UNKNOWN
    depth = np.count_nonzero(covered & (np.abs(map_m - depth_m) < _DEPTH_SHARE * depth_m)) / covered_px
    if only_contradiction and depth >= _MIN_DEPTH:
        return Agreement.UNKNOWN
    small = reduced(frame, _WIDTH_PX)
    size = small.camera.width_px, small.camera.height_px
    rgb = np.float32(255.0) * np.clip(cv2.resize(rendered.rgb, size, interpolation=cv2.INTER_AREA), 0.0, 1.0)
    texture = texture_correlation(blurred_luminance(rgb), blurred_luminance(small.rgb), covered)
    if depth >= _MIN_DEPTH or texture >= _MAX_TEXTURE:
        return Agreement.AGREES if depth >= _MIN_DEPTH and texture >= _MIN_TEXTURE else Agreement.UNKNOWN
    # along a wall and beside a border, a pixel more or less is half a metre of depth
    nearest_m, farthest_m = cv2.erode(depth_m, _AROUND), cv2.dilate(map_m, _AROUND)
    seen_through = covered & (nearest_m > (1.0 + _DEPTH_SHARE) * farthest_m + _THROUGH_M)
    contradicted = np.count_nonzero(seen_through) / measured_px + _in_free_space(small, earlier)
    return Agreement.CONTRADICTS if contradicted >= _MIN_CONTRADICTED else Agreement.UNKNOWN


def is_another_place(frame: Frame, earlier: Frame) -> bool:
    """True if two frames of one odometry contradict each other: it did not follow the robot between them."""
    return _in_free_space(reduced(frame, _WIDTH_PX), (earlier,)) >= _MIN_CONTRADICTED


def _in_free_space(small: Frame, earlier: Sequence[Frame]) -> float:
    """Return the share of the measured points where an earlier frame saw free space, and none a surface."""
    points_m = back_project(small.depth_m, small.camera)[::_POINT_STEP, ::_POINT_STEP]
    p_world: Float32[ndarray, "n 3"] = transform_points(
        small.T_world_camera, points_m[points_m[..., 2] > 0].reshape(-1, 3)
    ).astype(np.float32)
    free, shown = np.zeros((2, len(p_world)), np.bool_)
    for frame in earlier:
        camera = frame.camera.narrower(_WIDTH_PX)
        view = DepthView.of(_reduced_image(frame.depth_m, camera), camera, frame.T_world_camera)
        free |= view.sees_through(p_world, _THROUGH_M, _THROUGH_SHARE)
        shown |= view.classify(p_world)[1]
    return float(np.count_nonzero(free & ~shown)) / max(len(p_world), 1)


def _reduced_image(image: Float32[ndarray, "h w"], camera: Camera) -> Float32[ndarray, "rh rw"]:
    """Return the pixels of an image that a smaller camera keeps."""
    return cv2.resize(image, (camera.width_px, camera.height_px), interpolation=cv2.INTER_NEAREST)
