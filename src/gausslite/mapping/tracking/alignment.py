"""Align a frame to a rendering of the map by luminance and depth, coarse to fine (frame-to-model tracking).

Gauss-Newton minimises photometric and point-to-plane residuals together, as in KinectFusion (Newcombe et al. 2011,
Eq. 16) and Kintinuous (Whelan et al. 2015). Rendered points are associated with the pixels that they project to, so one
rendering serves all steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of, twist_of
from gausslite.render.rasterizer import NEAR_M, Rendering

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_MAX_POINTS = 5000
_MIN_POINTS = 300
"""An alignment needs at least this many pairs of rendered and measured points."""
_OPAQUE_ALPHA = 0.8
_NORMAL_WINDOW_PX = 5
_MIN_LUMINANCE_STD, _MIN_PLANE_STD_M = 0.01, 0.002
_OUTLIER_STDS = 2.0
_CORRELATED_PX = 64.0
"""Residuals of neighbouring pixels are correlated: one pixel in a cell of 8x8 counts as independent."""
_CONVERGED = 1e-4
"""Steps end when the pose changes by less than this, in metres and radians."""


@dataclass(frozen=True, slots=True)
class PyramidLevel:
    """One level of the pyramid: the blur of both images, the largest depth difference of a pair, and its steps.

    max_depth_error: as a share of the depth.
    """

    blur_px: float
    max_depth_error: float
    steps: int


COARSE_TO_FINE = (PyramidLevel(5.0, 0.15, 4), PyramidLevel(2.0, 0.08, 4), PyramidLevel(0.8, 0.05, 4))
FINE = COARSE_TO_FINE[1:]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A frame's pose aligned to the map.

    overlap: share of the rendered points in the image with a depth reading whose depth agrees with it. residual: robust
    standard deviation of the luminance differences, in [0, 1], after a fit of gain and offset.
    """

    T_world_camera: Float64[ndarray, "4 4"]
    overlap: float
    residual: float


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Normal equations of one step: twist (6), gain and offset of the luminance."""

    information: Float64[ndarray, "8 8"]
    gradient: Float64[ndarray, "8"]
    overlap: float
    residual: float


def align(
    rendering: Rendering,
    T_world_rendered: Float64[ndarray, "4 4"],
    frame: Frame,
    prior_std: Float64[ndarray, "6"],
    levels: tuple[PyramidLevel, ...] = COARSE_TO_FINE,
) -> Alignment | None:
    """Return the frame's pose near the rendered pose; None if too few of the rendered points agree with the frame.

    prior_std: standard deviations of the pose around the rendered one, translation (m) and rotation (rad).
    """
    model = _Model.of(rendering, frame.camera, levels)
    if model is None:
        return None
    luminance = frame.rgb @ (_LUMINANCE / np.float32(255.0))
    precision = np.append(1.0 / np.square(prior_std), (1.0, 1.0))
    T_camera_rendered = np.eye(4)
    system: _System | None = None
    for i, level in enumerate(levels):
        photograph = _Photograph(_with_gradient(luminance, level.blur_px), frame.depth_m, frame.camera)
        for _ in range(level.steps):
            system = model.linearise(i, photograph, T_camera_rendered, level.max_depth_error)
            if system is None:
                return None
            deviation = np.append(twist_of(T_camera_rendered), (0.0, 0.0))
            update = np.linalg.solve(system.information + np.diag(precision), system.gradient - precision * deviation)
            T_camera_rendered = transform_of(update[:6]) @ T_camera_rendered
            if np.abs(update[:6]).max() < _CONVERGED:
                break
    assert system is not None
    return Alignment(T_world_rendered @ inverse(T_camera_rendered), system.overlap, system.residual)


@dataclass(frozen=True, slots=True, eq=False)
class _Photograph:
    """The frame: blurred luminance with its gradients by column and row, and depth."""

    luminance: Float32[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Rendered points moved to the frame's camera, their pixels, and the measured depth there, for `model` rows."""

    model: Int64[ndarray, " n"]
    points: Float64[ndarray, "n 3"]
    u: Float64[ndarray, " n"]
    v: Float64[ndarray, " n"]
    measured_m: Float64[ndarray, " n"]
    overlap: float


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Points of the rendering in its camera, on an even grid: position, unit normal (0 if unknown), luminance by level.

    share: how many independent residuals a point stands for, at most 1.
    """

    points: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]
    luminance: tuple[Float64[ndarray, " n"], ...]
    share: float

    @classmethod
    def of(cls, rendering: Rendering, camera: Camera, levels: tuple[PyramidLevel, ...]) -> _Model | None:
        """Return the model, or None if the map covers too little of the view."""
        height, width = rendering.alpha.shape
        stride = int(np.ceil(np.sqrt(height * width / _MAX_POINTS)))
        grid = np.zeros((height, width), np.bool_)
        grid[stride // 2 :: stride, stride // 2 :: stride] = True
        depth_m = rendering.expected_depth_m(_OPAQUE_ALPHA)
        pixels = np.flatnonzero(grid & (depth_m > NEAR_M))
        if len(pixels) < _MIN_POINTS:
            return None
        points = back_project(depth_m, camera)
        luminance = np.clip(rendering.rgb, 0.0, 1.0) @ _LUMINANCE
        blurred = (cv2.GaussianBlur(luminance, (0, 0), level.blur_px) for level in levels)
        return cls(
            points.reshape(-1, 3)[pixels].astype(np.float64),
            _normals(points, depth_m).reshape(-1, 3)[pixels].astype(np.float64),
            tuple(image.ravel()[pixels].astype(np.float64) for image in blurred),
            min(1.0, stride**2 / _CORRELATED_PX),
        )

    def linearise(
        self, level: int, photograph: _Photograph, T_camera_rendered: Float64[ndarray, "4 4"], max_depth_error: float
    ) -> _System | None:
        """Return the normal equations at a pose; None with too few pairs."""
        pairs = self._associate(photograph, T_camera_rendered, max_depth_error)
        if pairs is None:
            return None
        jacobian, residual = _luminance_residuals(self.luminance[level][pairs.model], photograph, pairs)
        residual_std = max(_robust_std(residual - np.median(residual)), _MIN_LUMINANCE_STD)
        weight = self.share * _geman_mcclure((residual - np.median(residual)) / residual_std) / residual_std**2
        weighted = jacobian * weight[:, None]
        information, gradient = weighted.T @ jacobian, -(weighted.T @ residual)
        normals = self.normals[pairs.model] @ T_camera_rendered[:3, :3].T
        plane_jacobian, plane_residual = _plane_residuals(normals, photograph.camera, pairs)
        plane_std = max(_robust_std(plane_residual), _MIN_PLANE_STD_M)
        weighted = plane_jacobian * (self.share * _geman_mcclure(plane_residual / plane_std) / plane_std**2)[:, None]
        information[:6, :6] += weighted.T @ plane_jacobian
        gradient[:6] += weighted.T @ plane_residual
        return _System(information, gradient, pairs.overlap, residual_std)

    def _associate(
        self, photograph: _Photograph, T_camera_rendered: Float64[ndarray, "4 4"], max_depth_error: float
    ) -> _Pairs | None:
        camera = photograph.camera
        moved = self.points @ T_camera_rendered[:3, :3].T + T_camera_rendered[:3, 3]
        z = np.maximum(moved[:, 2], NEAR_M)
        # pixel centres at integers, as in cv2.remap
        u = camera.fx_px * moved[:, 0] / z + camera.cx_px - 0.5
        v = camera.fy_px * moved[:, 1] / z + camera.cy_px - 0.5
        inside = (u >= 1) & (v >= 1) & (u <= camera.width_px - 2) & (v <= camera.height_px - 2) & (moved[:, 2] > NEAR_M)
        model = np.flatnonzero(inside)
        measured_m = photograph.depth_m[np.rint(v[model]).astype(np.int64), np.rint(u[model]).astype(np.int64)]
        known = measured_m > 0
        agrees = known & (np.abs(measured_m - z[model]) < max_depth_error * z[model])
        count = int(np.count_nonzero(agrees))
        if count < _MIN_POINTS:
            return None
        overlap = count / int(np.count_nonzero(known))
        model = model[agrees]
        return _Pairs(model, moved[model], u[model], v[model], measured_m[agrees].astype(np.float64), overlap)


def _luminance_residuals(
    model_luminance: Float64[ndarray, " n"], photograph: _Photograph, pairs: _Pairs
) -> tuple[Float64[ndarray, "n 8"], Float64[ndarray, " n"]]:
    """Return the Jacobian by twist, gain and offset, and the residual photograph - model."""
    columns, rows = pairs.u.astype(np.float32)[:, None], pairs.v.astype(np.float32)[:, None]
    sampled = cv2.remap(photograph.luminance, columns, rows, cv2.INTER_LINEAR).reshape(-1, 3).astype(np.float64)
    x, y, z = pairs.points.T
    by_x, by_y = sampled[:, 1] * photograph.camera.fx_px / z, sampled[:, 2] * photograph.camera.fy_px / z
    by_z = -(by_x * x + by_y * y) / z
    rotation = [by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y]
    jacobian = np.stack([by_x, by_y, by_z, *rotation, -model_luminance, -np.ones_like(x)], axis=1)
    return jacobian, sampled[:, 0] - model_luminance


def _plane_residuals(
    normals: Float64[ndarray, "n 3"], camera: Camera, pairs: _Pairs
) -> tuple[Float64[ndarray, "n 6"], Float64[ndarray, " n"]]:
    """Return the Jacobian by twist of the moved points along their normals, and the measured points' distance there."""
    z = pairs.measured_m
    # the measured point at the centre of its pixel
    x = (np.rint(pairs.u) + 0.5 - camera.cx_px) / camera.fx_px * z
    y = (np.rint(pairs.v) + 0.5 - camera.cy_px) / camera.fy_px * z
    jacobian = np.concatenate([normals, np.cross(pairs.points, normals)], axis=1)
    return jacobian, np.einsum("ij,ij->i", normals, np.stack([x, y, z], axis=1) - pairs.points)


def _robust_std(values: Float64[ndarray, " n"]) -> float:
    return 1.4826 * float(np.median(np.abs(values)))


def _geman_mcclure(scaled: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    weights: Float64[ndarray, " n"] = np.square(1.0 / (1.0 + np.square(scaled / _OUTLIER_STDS)))
    return weights


def _with_gradient(luminance: Float32[ndarray, "h w"], blur_px: float) -> Float32[ndarray, "h w 3"]:
    blurred = cv2.GaussianBlur(luminance, (0, 0), blur_px)
    dx = cv2.Sobel(blurred, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(blurred, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    merged: Float32[ndarray, "h w 3"] = cv2.merge([blurred, dx, dy])
    return merged


def _normals(points: Float32[ndarray, "h w 3"], depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
    """Return unit normals of the smoothed surface; 0 near pixels without a depth."""
    known = (depth_m > 0).astype(np.float32)
    smooth = cv2.blur(points * known[..., None], (_NORMAL_WINDOW_PX, _NORMAL_WINDOW_PX))
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    # component by component: faster than np.cross
    cross = np.stack([dx[..., i] * dy[..., j] - dx[..., j] * dy[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)
    length = np.sqrt(np.square(cross).sum(axis=-1, keepdims=True))
    side = _NORMAL_WINDOW_PX + 2
    complete = cv2.erode(known, np.ones((side, side), np.uint8)) > 0
    normals: Float32[ndarray, "h w 3"] = np.zeros_like(cross)
    np.divide(cross, length, out=normals, where=complete[..., None] & (length > 1e-12))
    return normals
