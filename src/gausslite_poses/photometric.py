"""Align a photograph to a rendering of the map: Gauss-Newton on luminance and depth, coarse to fine, under a prior.

Points of the rendering are moved by the pose and looked up in the photograph (direct image alignment). Splats move
rigidly with the camera, so this equals the derivative through the rasterizer, and one rendering serves all steps.
Refinement uses the luminance of fixed pixels. Tracking, which starts farther away, associates the points anew in each
step and adds point-to-plane residuals: KinectFusion (Newcombe et al. 2011, Eq. 16), Kintinuous (Whelan et al. 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project, lift
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of, twist_of
from gausslite.domain.recording import PoseExposurePrior
from gausslite.render.rasterizer import NEAR_M, Rendering
from gausslite_poses.least_squares import (
    MIN_STD,
    NormalEquations,
    robust_std,
    robust_weights,
    shrinkage,
    weights_at,
)

OPAQUE_ALPHA = 0.8
"""Pixels of a higher alpha count as covered by the map."""
MAX_RELATIVE_DEPTH_ERROR = 0.05
"""Rendered and measured depth within this fraction belong to the same surface."""
MIN_PIXELS = 200
"""A refinement needs at least this many comparable pixels."""
MAX_PIXELS = 12_000
_MAX_TRACKED_POINTS, _MIN_TRACKED_POINTS = 5000, 300
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_CORRELATED_PX = 64.0
"""Residuals of neighbouring pixels are correlated: one pixel in a cell of 8x8 counts as independent."""
_MIN_TRACKED_STD, _MIN_PLANE_STD_M = 0.01, 0.002
_NORMAL_WINDOW_PX = 5
_NUISANCE_STD = 1.0
"""Prior of the global gain and offset that are fitted along with the pose and then dropped."""
_CONVERGED = 1e-4
"""A level ends when the pose changes by less than this, in metres and radians."""
_FIT_STD_PX = 0.2
"""Error of the fit itself on a map that still grows, at the median depth: a larger image gives a better fit.

`shrinkage` leaves a part of every true correction undone, so this must stay small.
"""


@dataclass(frozen=True, slots=True)
class PyramidLevel:
    """One level of the pyramid: the blur of both images and the steps.

    max_depth_error: largest difference of an associated point's depth to the measured one, as a share of the depth;
    None if points are not associated by depth.
    """

    blur_px: float
    steps: int
    max_depth_error: float | None = None


REFINEMENT = (PyramidLevel(3.0, 3), PyramidLevel(1.5, 3), PyramidLevel(0.8, 3))
COARSE_TO_FINE = (PyramidLevel(5.0, 4, 0.15), PyramidLevel(2.0, 4, 0.08), PyramidLevel(0.8, 4, 0.05))
FINE = COARSE_TO_FINE[1:]


def comparable_pixels(rendering: Rendering, frame: Frame, max_pixels: int = MAX_PIXELS) -> Int64[ndarray, " n"]:
    """Return flat indices, on an even grid of at most so many pixels, where both images show the same surface."""
    stride = _grid_stride(rendering, max_pixels)
    grid = (slice(stride // 2, None, stride),) * 2
    alpha, measured_m = rendering.alpha[grid], frame.depth_m[grid]
    # |depth / alpha - measured| without the division
    depth_error_m = np.abs(rendering.depth_m[grid] - alpha * measured_m)
    same_surface = depth_error_m < MAX_RELATIVE_DEPTH_ERROR * alpha * measured_m
    rows, columns = np.nonzero((alpha > OPAQUE_ALPHA) & same_surface)
    pixels: Int64[ndarray, " n"] = (
        (rows * stride + stride // 2) * rendering.alpha.shape[1] + columns * stride + stride // 2
    )
    return pixels


def independent_share(rendering: Rendering, max_pixels: int = MAX_PIXELS) -> float:
    """Return how many independent residuals one pixel of an even grid of so many stands for, at most 1."""
    return min(1.0, _grid_stride(rendering, max_pixels) ** 2 / _CORRELATED_PX)


def blurred_luminance(rgb: UInt8[ndarray, "h w 3"], blur_px: float) -> Float32[ndarray, "h w"]:
    """Return the luminance from 0 to 1, blurred by a Gaussian of this deviation."""
    return _blurred(_luminance(rgb), blur_px)


def rendered_luminance(
    rgb: Float32[ndarray, "h w 3"], pixels: Int64[ndarray, " n"], blurs_px: Sequence[float]
) -> tuple[Float64[ndarray, " n"], ...]:
    """Return the luminance of rendered colours at flat pixel indices, for each blur."""
    luminance: Float32[ndarray, "h w"] = cv2.transform(rgb, _LUMINANCE[None])
    return tuple(_blurred(luminance, blur_px).ravel()[pixels].astype(np.float64) for blur_px in blurs_px)


def _luminance(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    luminance: Float32[ndarray, "h w"] = cv2.transform(rgb.astype(np.float32), _LUMINANCE[None] / np.float32(255.0))
    return luminance


def _blurred(luminance: Float32[ndarray, "h w"], blur_px: float) -> Float32[ndarray, "h w"]:
    blurred: Float32[ndarray, "h w"] = cv2.GaussianBlur(luminance, (0, 0), blur_px)
    return blurred


def with_gradients(luminance: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w 3"]:
    """Return the luminance with its derivatives by x and y, per pixel."""
    dx = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    merged: Float32[ndarray, "h w 3"] = cv2.merge([luminance, dx, dy])
    return merged


@dataclass(frozen=True, slots=True, eq=False)
class VisiblePoints:
    """Points of a rendering that the camera sees, `index` their rows there.

    pixels: (column, row) from pixel centres at integers, as in cv2.remap.
    """

    index: Int64[ndarray, " m"]
    points: Float64[ndarray, "m 3"]
    pixels: Float64[ndarray, "m 2"]

    @classmethod
    def of(
        cls, points: Float64[ndarray, "n 3"], T_camera_rendered: Float64[ndarray, "4 4"], camera: Camera
    ) -> VisiblePoints:
        """Return the points inside the image, given in the rendered view."""
        # coordinates in rows: NumPy is twice as fast on them
        moved = T_camera_rendered[:3, :3] @ points.T + T_camera_rendered[:3, 3:]
        z_m = np.maximum(moved[2], NEAR_M)
        u, v = (axis - 0.5 for axis in camera.pixels(moved[0] / z_m, moved[1] / z_m))
        inside = (u >= 1) & (v >= 1) & (u <= camera.width_px - 2) & (v <= camera.height_px - 2) & (moved[2] > NEAR_M)
        index = np.flatnonzero(inside)
        return cls(index, moved[:, index].T, np.stack([u[index], v[index]]).T)

    def only(self, mask: Bool[ndarray, " m"]) -> VisiblePoints:
        """Return those of the mask."""
        return VisiblePoints(self.index[mask], self.points[mask], self.pixels[mask])

    def sample(self, image: Float32[ndarray, "h w c"]) -> Float64[ndarray, "m c"]:
        """Return bilinear values of an image. cv2.remap takes at most 32767 points, more than `comparable_pixels`."""
        columns, rows = (np.ascontiguousarray(axis)[:, None] for axis in self.pixels.astype(np.float32).T)
        sampled = cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(len(self.pixels), -1)
        return sampled.astype(np.float64)

    def measured(self, depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, " m"]:
        """Return the depth measured at the nearest pixels."""
        columns, rows = np.rint(self.pixels).astype(np.int64).T
        measured_m: Float32[ndarray, " m"] = depth_m[rows, columns]
        return measured_m


def luminance_residuals(
    model_luminance: Float64[ndarray, " m"],
    photograph: Float32[ndarray, "h w 3"],
    visible: VisiblePoints,
    camera: Camera,
) -> tuple[Float64[ndarray, "m 8"], Float64[ndarray, " m"]]:
    """Return the Jacobian by twist, gain and offset, and the residual photograph - model.

    photograph: luminance with its gradients; model_luminance: of the visible points.
    """
    sampled = visible.sample(photograph)
    by_x, by_y, by_z = camera.gradient_by_point(sampled[:, 1], sampled[:, 2], visible.points)
    x, y, z = visible.points.T
    rotation = [by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y]
    jacobian = np.stack([by_x, by_y, by_z, *rotation, -model_luminance, -np.ones_like(x)]).T
    return jacobian, sampled[:, 0] - model_luminance


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A frame's pose aligned to the map.

    overlap: share of the rendered points in the image with a depth reading whose depth agrees with it. residual: robust
    standard deviation of the luminance differences, in [0, 1], after a fit of gain and offset.
    """

    T_world_camera: Float64[ndarray, "4 4"]
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
    model = _Model.of_surface(rendering, frame.camera, levels)
    if model is None:
        return None
    found = _solve(model, frame, levels, np.eye(4), prior_std)
    if found is None:
        return None
    return Alignment(T_world_rendered @ inverse(found.T_camera_rendered), found.overlap, found.residual)


def align_images(
    reference: Frame, frame: Frame, T_reference_camera: Float64[ndarray, "4 4"], prior_std: Float64[ndarray, "6"]
) -> Alignment | None:
    """Return the frame's pose in the reference's camera, near the given one, as `align` does with a rendering."""
    measured = (reference.depth_m > 0).astype(np.float32)
    image = Rendering(reference.rgb.astype(np.float32) / np.float32(255.0), reference.depth_m, measured, None)
    model = _Model.of_surface(image, reference.camera, FINE)
    if model is None:
        return None
    found = _solve(model, frame, FINE, T_reference_camera, prior_std, inverse(T_reference_camera))
    return None if found is None else Alignment(inverse(found.T_camera_rendered), found.overlap, found.residual)


def fit_pose(
    rendering: Rendering,
    T_rendered_world: Float64[ndarray, "4 4"],
    frame: Frame,
    prior: PoseExposurePrior,
    max_pixels: int = MAX_PIXELS,
) -> Float64[ndarray, "4 4"]:
    """Return T_world_camera of the frame, aligned to a rendering from a nearby pose.

    The search starts at the rendered pose; the prior is centred on frame.T_world_camera, the odometry's pose. Returns
    the odometry's pose if the prior allows no pose error or fewer than 200 pixels are comparable.
    """
    pixels = comparable_pixels(rendering, frame, max_pixels)
    if not prior.has_pose_error or len(pixels) < MIN_PIXELS:
        return frame.T_world_camera
    share = independent_share(rendering, max_pixels)
    model = _Model.of_pixels(rendering, frame.camera, pixels, REFINEMENT, share)
    prior_std = np.array([prior.translation_m] * 3 + [np.radians(prior.rotation_deg)] * 3)
    T_rendered_odometry = T_rendered_world @ frame.T_world_camera
    solution = _solve(model, frame, REFINEMENT, T_rendered_odometry, prior_std)
    assert solution is not None
    deviation = twist_of(solution.T_camera_rendered @ T_rendered_odometry)
    for part, depth_m in ((slice(3), float(np.median(model.points[:, 2]))), (slice(3, 6), 1.0)):
        deviation[part] *= shrinkage(prior_std[part][0], frame.camera.length_m(_FIT_STD_PX, depth_m))
    T_world_camera: Float64[ndarray, "4 4"] = frame.T_world_camera @ inverse(transform_of(deviation))
    return T_world_camera


def luminance_residual(rendering: Rendering, frame: Frame, T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the robust standard deviation of the luminance residual, in [0, 1], after a fit of gain and offset.

    rendering: from frame.T_world_camera; T_world_camera: the pose that the photograph is compared from.
    """
    pixels = comparable_pixels(rendering, frame)
    model = _Model.of_pixels(rendering, frame.camera, pixels, REFINEMENT[-1:])
    visible = VisiblePoints.of(model.points, inverse(T_world_camera) @ frame.T_world_camera, frame.camera)
    photograph = with_gradients(blurred_luminance(frame.rgb, REFINEMENT[-1].blur_px))
    jacobian, residual = luminance_residuals(model.luminance[0][visible.index], photograph, visible, frame.camera)
    exposure = jacobian[:, 6:]
    return robust_std(residual - exposure @ np.linalg.lstsq(exposure, residual, rcond=None)[0])


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """The rendered camera's pose in the frame's camera; overlap and residual as in `Alignment`, of the last step."""

    T_camera_rendered: Float64[ndarray, "4 4"]
    overlap: float
    residual: float


def _solve(
    model: _Model,
    frame: Frame,
    levels: Sequence[PyramidLevel],
    T_rendered_prior: Float64[ndarray, "4 4"],
    prior_std: Float64[ndarray, "6"],
    T_camera_rendered: Float64[ndarray, "4 4"] = np.eye(4),  # noqa: B008 - never written
) -> _Solution | None:
    """Return the pose that minimises the residuals under the prior; None if too few points agree with the frame.

    The steps start at T_camera_rendered. T_rendered_prior: its mean. prior_std: translation (m), rotation (rad).
    """
    parameters_std = np.append(prior_std, (_NUISANCE_STD, _NUISANCE_STD))
    solution: _Solution | None = None
    luminance = _luminance(frame.rgb)
    for i, level in enumerate(levels):
        photograph = with_gradients(_blurred(luminance, level.blur_px))
        for _ in range(level.steps):
            step = model.linearise(i, level, frame, photograph, T_camera_rendered)
            if step is None:
                return None
            deviation = np.append(twist_of(T_camera_rendered @ T_rendered_prior), (0.0, 0.0))
            update = step.equations.solve(deviation, parameters_std)
            T_camera_rendered = transform_of(update[:6]) @ T_camera_rendered
            solution = _Solution(T_camera_rendered, step.overlap, step.residual)
            if np.abs(update[:6]).max() < _CONVERGED:
                break
    return solution


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    equations: NormalEquations
    overlap: float
    residual: float


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Points of the rendering in its camera, and their luminance by level; normals (0 if unknown) if depth counts.

    share: how many independent residuals a point stands for, at most 1.
    """

    points: Float64[ndarray, "n 3"]
    luminance: tuple[Float64[ndarray, " n"], ...]
    share: float
    normals: Float64[ndarray, "n 3"] | None = None

    @classmethod
    def of_pixels(
        cls,
        rendering: Rendering,
        camera: Camera,
        pixels: Int64[ndarray, " n"],
        levels: Sequence[PyramidLevel],
        share: float = 1.0,
    ) -> _Model:
        """Return the model of the luminance at these flat pixel indices, of which each counts as this share."""
        rows, columns = np.divmod(pixels, camera.width_px)
        depth_m = rendering.depth_m.ravel()[pixels].astype(np.float64) / rendering.alpha.ravel()[pixels]
        points = lift(np.stack([columns, rows], axis=1) + 0.5, depth_m, camera)
        luminance = rendered_luminance(rendering.rgb, pixels, [level.blur_px for level in levels])
        return cls(points, luminance, share)

    @classmethod
    def of_surface(cls, rendering: Rendering, camera: Camera, levels: Sequence[PyramidLevel]) -> _Model | None:
        """Return the model of luminance and surface on an even grid; None if the map covers too little of the view."""
        depth_m = rendering.expected_depth_m(OPAQUE_ALPHA)
        pixels = np.flatnonzero(_grid(rendering, _MAX_TRACKED_POINTS) & (depth_m > NEAR_M))
        if len(pixels) < _MIN_TRACKED_POINTS:
            return None
        points = back_project(depth_m, camera)
        return cls(
            points.reshape(-1, 3)[pixels].astype(np.float64),
            rendered_luminance(np.clip(rendering.rgb, 0.0, 1.0), pixels, [level.blur_px for level in levels]),
            independent_share(rendering, _MAX_TRACKED_POINTS),
            _normals(points, depth_m).reshape(-1, 3)[pixels].astype(np.float64),
        )

    def linearise(
        self,
        i: int,
        level: PyramidLevel,
        frame: Frame,
        photograph: Float32[ndarray, "h w 3"],
        T_camera_rendered: Float64[ndarray, "4 4"],
    ) -> _Step | None:
        """Return the normal equations of the i-th level at a pose; None if too few points agree with the frame."""
        visible = VisiblePoints.of(self.points, T_camera_rendered, frame.camera)
        overlap, min_std = 1.0, MIN_STD
        if level.max_depth_error is not None:
            measured_m, z_m = visible.measured(frame.depth_m), visible.points[:, 2]
            agrees = (measured_m > 0) & (np.abs(measured_m - z_m) < level.max_depth_error * z_m)
            count = int(np.count_nonzero(agrees))
            if count < _MIN_TRACKED_POINTS:
                return None
            overlap, min_std = count / int(np.count_nonzero(measured_m > 0)), _MIN_TRACKED_STD
            visible = visible.only(agrees)
        jacobian, residual = luminance_residuals(self.luminance[i][visible.index], photograph, visible, frame.camera)
        # far from the solution, gain and offset dominate the residuals of all points together
        spread = residual if self.normals is None else residual - np.median(residual)
        spread_std = max(robust_std(spread), min_std)
        equations = NormalEquations.of(jacobian, residual, self.share * weights_at(spread, spread_std))
        if self.normals is not None:
            normals = self.normals[visible.index] @ T_camera_rendered[:3, :3].T
            plane_jacobian, plane_residual = _plane_residuals(normals, frame, visible)
            weights = self.share * robust_weights(plane_residual, _MIN_PLANE_STD_M)
            equations = equations.plus(NormalEquations.of(plane_jacobian, plane_residual, weights))
        return _Step(equations, overlap, spread_std)


def _plane_residuals(
    normals: Float64[ndarray, "n 3"], frame: Frame, visible: VisiblePoints
) -> tuple[Float64[ndarray, "n 6"], Float64[ndarray, " n"]]:
    """Return the Jacobian by twist, and the distance of the measured points from the visible ones along the normals."""
    # the measured point is that at the centre of its pixel
    centres_px = np.rint(visible.pixels) + 0.5
    measured = lift(centres_px, visible.measured(frame.depth_m).astype(np.float64), frame.camera)
    jacobian = -np.concatenate([normals, np.cross(visible.points, normals)], axis=1)
    return jacobian, np.einsum("ij,ij->i", normals, measured - visible.points)


def _grid(rendering: Rendering, max_pixels: int) -> Bool[ndarray, "h w"]:
    """Return the mask of an even grid of at most so many pixels."""
    stride = _grid_stride(rendering, max_pixels)
    grid = np.zeros(rendering.alpha.shape, np.bool_)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    return grid


def _grid_stride(rendering: Rendering, max_pixels: int) -> int:
    height, width = rendering.alpha.shape
    return int(np.ceil(np.sqrt(height * width / max_pixels)))


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
