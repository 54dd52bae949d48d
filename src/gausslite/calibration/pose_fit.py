"""Fit a view's pose to the map by direct image alignment: Gauss-Newton on the luminance, under a pose prior.

Rendered pixels are lifted by the rendered depth, moved by the pose, and looked up in the photograph. Splats move
rigidly with the camera, so this equals the derivative through the rasterizer, and one rendering serves all steps.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.calibration.luminance_alignment import LuminancePair, linearise
from gausslite.calibration.view_residuals import (
    MIN_PIXELS,
    OPAQUE_ALPHA,
    comparable_pixels,
    independent_share,
    shrinkage,
    solve_with_prior,
)
from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of, twist_of
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.render.rasterizer import Rendering

_BLURS_PX = (3.0, 1.5, 0.8)
_STEPS_PER_BLUR = 3
_FIT_TRANSLATION_STD_M, _FIT_ROTATION_STD_DEG = 0.002, 0.1
"""Error of the fit itself on a map that still grows, measured where poses are exact.

`shrinkage` leaves a part of every true correction undone, so these must stay small.
"""
_NUISANCE_STD = 1.0
"""Prior of the global gain and offset that are fitted along with the pose and then dropped."""


def fit_pose(
    rendering: Rendering, T_rendered_world: Float64[ndarray, "4 4"], frame: Frame, prior: PoseExposurePrior
) -> Float64[ndarray, "4 4"]:
    """Return T_world_camera of the frame, aligned to a rendering from a nearby pose.

    The search starts at the rendered pose; the prior is centred on frame.T_world_camera, the odometry's pose. Returns
    the odometry's pose if the prior allows no pose error or fewer than 200 pixels are comparable.
    """
    pixels = comparable_pixels(rendering, frame)
    if not prior.has_pose_error or len(pixels) < MIN_PIXELS:
        return frame.T_world_camera
    points = back_project(rendering.expected_depth_m(OPAQUE_ALPHA), frame.camera).reshape(-1, 3)[pixels]
    rotation_rad = np.radians(prior.rotation_deg)
    prior_std = np.array([prior.translation_m] * 3 + [rotation_rad] * 3 + [_NUISANCE_STD] * 2)
    T_rendered_odometry = T_rendered_world @ frame.T_world_camera
    T_camera_rendered = np.eye(4)
    for blur_px in _BLURS_PX:
        images = LuminancePair.of(rendering, frame, pixels, blur_px)
        for _ in range(_STEPS_PER_BLUR):
            linear = linearise(images, points, T_camera_rendered, frame.camera)
            deviation = np.append(twist_of(T_camera_rendered @ T_rendered_odometry), (0.0, 0.0))
            update = solve_with_prior(
                -linear.jacobian, linear.residual, deviation, prior_std, independent_share(rendering)
            )
            T_camera_rendered = transform_of(update[:6]) @ T_camera_rendered
    deviation = twist_of(T_camera_rendered @ T_rendered_odometry)
    deviation[:3] *= shrinkage(prior.translation_m, _FIT_TRANSLATION_STD_M)
    deviation[3:] *= shrinkage(prior.rotation_deg, _FIT_ROTATION_STD_DEG)
    T_world_camera: Float64[ndarray, "4 4"] = frame.T_world_camera @ inverse(transform_of(deviation))
    return T_world_camera


def luminance_residual(rendering: Rendering, frame: Frame, T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the robust standard deviation of the luminance residual, in [0, 1], after a fit of gain and offset.

    rendering: from frame.T_world_camera; T_world_camera: the pose that the photograph is compared from.
    """
    pixels = comparable_pixels(rendering, frame)
    points = back_project(rendering.expected_depth_m(OPAQUE_ALPHA), frame.camera).reshape(-1, 3)[pixels]
    images = LuminancePair.of(rendering, frame, pixels, _BLURS_PX[-1])
    linear = linearise(images, points, inverse(T_world_camera) @ frame.T_world_camera, frame.camera)
    exposure = linear.jacobian[:, 6:]
    residual = linear.residual - exposure @ np.linalg.lstsq(exposure, linear.residual, rcond=None)[0]
    return 1.4826 * float(np.median(np.abs(residual)))
