"""Fit a view's pose to the map by direct image alignment: Gauss-Newton on the luminance, under a pose prior.

Rendered pixels are lifted by the rendered depth, moved by the pose, and looked up in the photograph. Splats move
rigidly with the camera, so this equals the derivative through the rasterizer, and one rendering serves all steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.calibration.view_residuals import (
    MIN_PIXELS,
    OPAQUE_ALPHA,
    comparable_pixels,
    independent_share,
    shrinkage,
    solve_with_prior,
)
from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of, twist_of
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.render.rasterizer import NEAR_M, Rendering

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
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
        images = _LuminancePair.of(rendering, frame, pixels, blur_px)
        for _ in range(_STEPS_PER_BLUR):
            jacobian, residual = _linearise(images, points, T_camera_rendered, frame.camera)
            deviation = np.append(twist_of(T_camera_rendered @ T_rendered_odometry), (0.0, 0.0))
            update = solve_with_prior(-jacobian, residual, deviation, prior_std, independent_share(rendering))
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
    images = _LuminancePair.of(rendering, frame, pixels, _BLURS_PX[-1])
    jacobian, residual = _linearise(images, points, inverse(T_world_camera) @ frame.T_world_camera, frame.camera)
    exposure = jacobian[:, 6:]
    residual = residual - exposure @ np.linalg.lstsq(exposure, residual, rcond=None)[0]
    return 1.4826 * float(np.median(np.abs(residual)))


@dataclass(frozen=True, slots=True, eq=False)
class _LuminancePair:
    """Blurred luminance: the map's at the compared pixels, and the photograph's with its x and y gradients."""

    model: Float64[ndarray, " n"]
    photograph: Float32[ndarray, "h w 3"]

    @classmethod
    def of(cls, rendering: Rendering, frame: Frame, pixels: Int64[ndarray, " n"], blur_px: float) -> _LuminancePair:
        model = cv2.GaussianBlur(rendering.rgb @ _LUMINANCE, (0, 0), blur_px)
        photograph = cv2.GaussianBlur(frame.rgb @ (_LUMINANCE / np.float32(255.0)), (0, 0), blur_px)
        dx = cv2.Sobel(photograph, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
        dy = cv2.Sobel(photograph, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
        return cls(model.ravel()[pixels].astype(np.float64), np.stack([photograph, dx, dy], axis=2))


def _linearise(
    images: _LuminancePair,
    points: Float32[ndarray, "n 3"],
    T_camera_rendered: Float64[ndarray, "4 4"],
    camera: Camera,
) -> tuple[Float64[ndarray, "m 8"], Float64[ndarray, " m"]]:
    """Return the Jacobian by twist, gain and offset, and the residual photograph - model, of points in the image."""
    moved = points.astype(np.float64) @ T_camera_rendered[:3, :3].T + T_camera_rendered[:3, 3]
    depth = np.maximum(moved[:, 2], NEAR_M)
    # cv2.remap places pixel centres at integers
    u = camera.fx_px * moved[:, 0] / depth + camera.cx_px - 0.5
    v = camera.fy_px * moved[:, 1] / depth + camera.cy_px - 0.5
    inside = (u >= 1) & (v >= 1) & (u <= camera.width_px - 2) & (v <= camera.height_px - 2) & (moved[:, 2] > NEAR_M)
    x, y, z = moved[inside].T
    model = images.model[inside]
    pixels = np.stack([u[inside], v[inside]], axis=1).astype(np.float32)[:, None]
    sampled = _sample_bilinear(images.photograph, pixels)
    by_x, by_y = sampled[:, 1] * camera.fx_px / z, sampled[:, 2] * camera.fy_px / z
    by_z = -(by_x * x + by_y * y) / z
    rotation = [by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y]
    jacobian = np.stack([by_x, by_y, by_z, *rotation, -model, -np.ones_like(model)], axis=1)
    return jacobian, sampled[:, 0] - model


def _sample_bilinear(image: Float32[ndarray, "h w 3"], pixels: Float32[ndarray, "n 1 2"]) -> Float64[ndarray, "n 3"]:
    """Return bilinear values at (column, row). cv2.remap takes at most 32767 points, more than `comparable_pixels`."""
    columns, rows = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
    sampled = cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(-1, 3)
    return sampled.astype(np.float64)
