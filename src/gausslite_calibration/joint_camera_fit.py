"""Fit lens, readout time and time offset to pairs of moving frames, jointly with the pose of each pair.

Gauss-Newton on the luminance: one frame of a pair is warped into the other by depth and poses. The residual depends on
the pair's pose, gain and offset, which are eliminated, and on the parameters of the camera, which all pairs share. The
poses of the source are a prior of each pair's pose. Its deviation is estimated along with the parameters: with a
wrong time the poses seem to err in proportion to the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Twist, inverse, transform_of, twist_of
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.corrected import correct_frame, recorded_pixels
from gausslite_calibration.moving_pairs import MIN_COMPARABLE_SHARE, FrameWarp, MovingPairs
from gausslite_poses.least_squares import NormalEquations, robust_weights
from gausslite_poses.photometric import (
    MAX_PIXELS,
    OPAQUE_ALPHA,
    VisiblePoints,
    blurred_luminance,
    comparable_pixels,
    independent_share,
    luminance_residuals,
    rendered_luminance,
    with_gradients,
)

_READOUT, _OFFSET = 0, 1
_STEPS = np.array([0.001, 0.001, 0.01, 0.02])
"""Differences of readout time, offset, k1 and k2 for numerical derivatives of the lookup."""
_RADIAL_SLOPES = np.array([1.0, 0.4])
"""Change of the relative distortion half way to the corner of an image 60 degrees wide, by k1 and k2."""
_PRIOR_STD = np.array([0.05, 0.05, 0.4, 0.1])
_LIMITS = np.array([0.06, 0.1, 0.8, 0.5])
_START_TRANSLATION_M, _START_ROTATION_RAD = 0.01, np.radians(0.5)
_LEAST_TRANSLATION_M, _LEAST_ROTATION_RAD = 0.001, np.radians(0.03)
_BLURS_PX = (3.0, 3.0) + (1.5,) * 8
_RELAXATION = 1.5
"""Image noise in the derivatives shortens each step; longer steps still converge."""
_CONVERGED_STDS = 0.1
_MIN_PAIRS = 2


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """The fitted correction, and standard errors by leaving out one pair at a time.

    radial, radial_std: the relative distortion half way to the image's corner, where the two coefficients exchange.
    """

    correction: CameraCorrection
    readout_std_s: float
    offset_std_s: float
    radial: float = 0.0
    radial_std: float = 0.0


def fit_camera(moving: MovingPairs, start: CameraCorrection, fits_lens: bool) -> CameraFit | None:
    """Return the fit that begins at `start`, None if fewer than two pairs can be compared.

    fits_lens: fit two radial coefficients too; otherwise the lens of `start` is kept.
    """
    parameters = _Parameters.of(start, fits_lens)
    poses = _PairPoses.initial(moving.pairs)
    covariance = np.zeros((len(parameters.values),) * 2)
    for blur_px in _BLURS_PX:
        twists = {i: moving.trajectory.twist(i) for i in moving.frames}
        views = {i: _View.of(frame, parameters, twists[i], blur_px) for i, frame in moving.frames.items()}
        systems = [
            system
            for pair in moving.pairs
            if pair[0] in views and pair[1] in views
            for system in _pair_system(pair, views[pair[0]], views[pair[1]], poses)
        ]
        if len(systems) < _MIN_PAIRS:
            return None
        update, covariance = _shared_update(systems, parameters.values)
        parameters = parameters.moved(_RELAXATION * update)
        poses = poses.moved(systems, _RELAXATION * update)
        is_converged = np.abs(update) < _CONVERGED_STDS * np.sqrt(np.diag(covariance))
        if blur_px == _BLURS_PX[-1] and bool(is_converged.all()):
            break
    readout_std_s, offset_std_s = (float(np.sqrt(covariance[k, k])) for k in (_READOUT, _OFFSET))
    if not fits_lens:
        return CameraFit(parameters.correction(), readout_std_s, offset_std_s)
    radial_std = float(np.sqrt(_RADIAL_SLOPES @ covariance[2:, 2:] @ _RADIAL_SLOPES))
    radial = float(_RADIAL_SLOPES @ parameters.values[2:])
    return CameraFit(parameters.correction(), readout_std_s, offset_std_s, radial, radial_std)


@dataclass(frozen=True, slots=True, eq=False)
class _Parameters:
    """Readout time, time offset and, if the lens is fitted, its two radial coefficients."""

    start: CameraCorrection
    values: Float64[ndarray, " p"]

    @classmethod
    def of(cls, start: CameraCorrection, fits_lens: bool) -> _Parameters:
        radial = list(start.lens.coefficients[:2] if start.lens is not None else (0.0, 0.0)) if fits_lens else []
        return cls(start, np.array([start.readout_s, start.time_offset_s, *radial]))

    def moved(self, update: Float64[ndarray, " p"]) -> _Parameters:
        limits = _LIMITS[: len(self.values)]
        return replace(self, values=np.clip(self.values + update, -limits, limits))

    def correction(self) -> CameraCorrection:
        lens = self.start.lens
        if len(self.values) == len(_STEPS):
            lens = Lens(LensModel.RADTAN, (float(self.values[2]), float(self.values[3]), 0.0, 0.0))
        readout_s, offset_s = float(self.values[_READOUT]), float(self.values[_OFFSET])
        return replace(self.start, lens=lens, readout_s=readout_s, time_offset_s=offset_s)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A corrected frame, its twist, its blurred luminance, and the luminance's derivatives by the parameters."""

    frame: Frame
    twist: Twist
    blur_px: float
    derivatives: Float32[ndarray, "h w p"]

    @classmethod
    def of(cls, recorded: Frame, parameters: _Parameters, twist: Twist, blur_px: float) -> _View:
        frame = correct_frame(recorded, parameters.correction(), recorded.camera, twist)
        camera, depth_m = recorded.camera, frame.depth_m
        lookup = recorded_pixels(camera, parameters.correction(), camera, twist, depth_m)
        gradients = with_gradients(blurred_luminance(recorded.rgb, blur_px))
        by_column, by_row = (cv2.remap(gradients[..., axis], *lookup, cv2.INTER_LINEAR) for axis in (1, 2))
        derivatives = np.zeros((*frame.depth_m.shape, len(parameters.values)), np.float32)
        for k in range(len(parameters.values)):
            # the offset moves the poses, not the pixels
            if k != _OFFSET:
                step = np.zeros(len(parameters.values))
                step[k] = _STEPS[k]
                (columns_after, rows_after), (columns_before, rows_before) = (
                    recorded_pixels(camera, parameters.moved(sign * step).correction(), camera, twist, depth_m)
                    for sign in (1.0, -1.0)
                )
                change = by_column * (columns_after - columns_before) + by_row * (rows_after - rows_before)
                derivatives[..., k] = change / np.float32(2.0 * _STEPS[k])
        return cls(frame, twist, blur_px, derivatives)


@dataclass(frozen=True, slots=True, eq=False)
class _PairSystem:
    """Normal equations of one pair after its own unknowns are eliminated: update = gain - slope · shared update.

    information, vector: of the shared parameters. offset_twist: how the offset moves the stated pose, per second.
    """

    pair: tuple[int, int]
    information: Float64[ndarray, "p p"]
    vector: Float64[ndarray, " p"]
    gain: Float64[ndarray, "8"]
    slope: Float64[ndarray, "8 p"]
    covariance: Float64[ndarray, "8 8"]
    offset_twist: Float64[ndarray, "6"]


@dataclass(frozen=True, slots=True, eq=False)
class _PairPoses:
    """Each pair's fitted pose relative to the stated one, and the standard deviation of these over the pairs."""

    T_camera_stated: dict[tuple[int, int], Float64[ndarray, "4 4"]]
    translation_std_m: float
    rotation_std_rad: float

    @classmethod
    def initial(cls, pairs: Sequence[tuple[int, int]]) -> _PairPoses:
        return cls({pair: np.eye(4) for pair in pairs}, _START_TRANSLATION_M, _START_ROTATION_RAD)

    @property
    def precision(self) -> Float64[ndarray, "6"]:
        std = np.array([self.translation_std_m] * 3 + [self.rotation_std_rad] * 3)
        precision: Float64[ndarray, "6"] = 1.0 / np.square(std)
        return precision

    def moved(self, systems: Sequence[_PairSystem], update: Float64[ndarray, " p"]) -> _PairPoses:
        """Return the poses after an update of the shared parameters, and their deviation for the next prior."""
        poses, squares = dict(self.T_camera_stated), []
        for system in systems:
            change = (system.gain - system.slope @ update)[:6]
            # the offset has moved the stated pose already
            stated = transform_of(-system.offset_twist * update[_OFFSET])
            poses[system.pair] = transform_of(change) @ poses[system.pair] @ stated
            squares.append(np.square(twist_of(poses[system.pair])) + np.diag(system.covariance)[:6])
        variances = np.median(np.array(squares).reshape(-1, 2, 3).mean(axis=2), axis=0)
        return _PairPoses(
            poses,
            max(float(np.sqrt(variances[0])), _LEAST_TRANSLATION_M),
            max(float(np.sqrt(variances[1])), _LEAST_ROTATION_RAD),
        )


def _pair_system(pair: tuple[int, int], first: _View, second: _View, poses: _PairPoses) -> list[_PairSystem]:
    """Return the pair's normal equations, nothing if the frames show too little in common."""
    warp = FrameWarp.of(first.frame, second.frame)
    warped = warp.rendering(first.frame)
    pixels = comparable_pixels(warped, second.frame)
    if len(pixels) < MIN_COMPARABLE_SHARE * min(warped.alpha.size, MAX_PIXELS):
        return []
    camera, T_camera_stated = second.frame.camera, poses.T_camera_stated[pair]
    points = back_project(warped.expected_depth_m(OPAQUE_ALPHA), camera).reshape(-1, 3)[pixels]
    visible = VisiblePoints.of(points.astype(np.float64), T_camera_stated, camera)
    [model] = rendered_luminance(warped.rgb, pixels[visible.index], (second.blur_px,))
    photograph = with_gradients(blurred_luminance(second.frame.rgb, second.blur_px))
    by_pair, residual = luminance_residuals(model, photograph, visible, camera)
    count = first.derivatives.shape[2]
    of_first = warp.apply(first.derivatives).reshape(-1, count)[pixels[visible.index]]
    jacobian = np.hstack([by_pair, visible.sample(second.derivatives) - of_first])
    equations = NormalEquations.of(jacobian, residual, robust_weights(residual) * independent_share(warped))
    offset_twist = _offset_twist(first, second)
    # the deviation of the pose from the stated one, which the offset moves, has the prior's precision
    deviation_by = np.hstack([np.eye(6), np.zeros((6, 2 + count))])
    deviation_by[:, 8 + _OFFSET] = -offset_twist
    weighted_prior = deviation_by.T * poses.precision
    information = equations.information + weighted_prior @ deviation_by
    vector = equations.gradient - weighted_prior @ twist_of(T_camera_stated)
    # a weak prior of the pair's gain and offset
    information[[6, 7], [6, 7]] += 1.0
    covariance = np.linalg.inv(information[:8, :8])
    slope, gain = covariance @ information[:8, 8:], covariance @ vector[:8]
    return [
        _PairSystem(
            pair=pair,
            information=information[8:, 8:] - information[8:, :8] @ slope,
            vector=vector[8:] - information[8:, :8] @ gain,
            gain=gain,
            slope=slope,
            covariance=covariance,
            offset_twist=offset_twist,
        )
    ]


def _offset_twist(first: _View, second: _View) -> Float64[ndarray, "6"]:
    """Return how the second camera's pose relative to the first changes per second of time offset."""
    T_second_first = inverse(second.frame.T_world_camera) @ first.frame.T_world_camera
    step_s = float(_STEPS[_OFFSET])
    T_later = inverse(second.twist.motion(step_s)) @ T_second_first @ first.twist.motion(step_s)
    twist: Float64[ndarray, "6"] = twist_of(T_later @ inverse(T_second_first)) / step_s
    return twist


def _shared_update(
    systems: Sequence[_PairSystem], values: Float64[ndarray, " p"]
) -> tuple[Float64[ndarray, " p"], Float64[ndarray, "p p"]]:
    """Return the update of the shared parameters, and its covariance by the jackknife over the pairs."""
    precision = np.diag(1.0 / np.square(_PRIOR_STD[: len(values)]))
    informations = np.array([system.information for system in systems])
    vectors = np.array([system.vector for system in systems])

    def solve(information: ndarray, vector: ndarray) -> ndarray:
        solution: ndarray = np.linalg.solve(information + precision, vector - precision @ values)
        return solution

    information, vector = informations.sum(axis=0), vectors.sum(axis=0)
    without = np.array([solve(information - informations[k], vector - vectors[k]) for k in range(len(systems))])
    count = len(systems)
    deviations = without - without.mean(axis=0)
    return solve(information, vector), (count - 1) / count * deviations.T @ deviations
