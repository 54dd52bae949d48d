"""Fit what a recording states of its camera to matched points: intrinsics and scale of depth, or the camera's mount.

Gauss-Newton on the distances between the points' places in the second image and where the stated motion moves them.
The mount is the camera's pose on the body whose poses are stated. Standard errors come from leaving out one pair at a
time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, lift
from gausslite.domain.pose import inverse, transform_of
from gausslite_poses.features import RelativePose
from gausslite_poses.least_squares import robust_weights

_CAMERA, _MOUNT = slice(0, 5), slice(5, 11)
_PRIOR_STD = np.array([0.5, 0.5, 0.2, 0.2, 0.5, *[1.0] * 3, *[0.5] * 3])
"""Logarithms of focal lengths, principal point in widths, logarithm of depth; the mount in metres and radians."""
_STEP, _LONGEST_STEP, _STEPS = 1e-4, 0.3, 8
_LEAST_STD, _LEAST_DEPTH_M = 0.0015, 1e-9
_POINTS_OF_PAIR = 4.0
"""Points of a frame have common errors: a pair counts as so many of them."""
_MAX_DISTANCE_SHARE, _LEAST_GAIN = 0.6, 0.003
"""Of the median distance, as a share of the stated one and of the image's width."""
_CERTAIN_STDS, _CLEAR_GAIN, _MOUNT_GAIN = 6.0, 0.95, 0.7
_MAX_FOCAL_CHANGE = math.log(3.0)
"""Beyond it, the points are no points of one camera."""
_LEAST_MOUNT_M, _LEAST_MOUNT_DEG = 0.05, 5.0


@dataclass(frozen=True, slots=True)
class Limits:
    """Least changes that count: logarithms of focal lengths and their ratio, and the centre in widths."""

    focal: float
    ratio: float
    centre: float


REGISTERED, UNREGISTERED = Limits(0.1, 0.08, 0.06), Limits(0.3, 0.15, 0.09)
"""Right recordings reach 0.06, 0.05 and 0.05 where depth is registered; otherwise 0.19, 0.06 and 0.07, because the
files state the depth camera."""

Change = Float64[ndarray, "11"]


@dataclass(frozen=True, slots=True, eq=False)
class PointMotion:
    """The points that two frames show, the camera, and the stated T_second_first."""

    matched: RelativePose
    camera: Camera
    T_second_first: Float64[ndarray, "4 4"]

    def residual(self, change: Change) -> Float64[ndarray, "n 2"]:
        """Return the distances in the second image, as shares of its width, with another camera, depth and mount."""
        camera, T_body_camera = _changed(self.camera, change), transform_of(change[_MOUNT])
        T = inverse(T_body_camera) @ self.T_second_first @ T_body_camera
        depths_m = self.matched.points_m[:, 2] * np.exp(change[4])
        moved = lift(self.matched.reference_px + 0.5, depths_m, camera) @ T[:3, :3].T + T[:3, 3]
        z_m = np.maximum(moved[:, 2], _LEAST_DEPTH_M)
        predicted = np.stack(camera.pixels(moved[:, 0] / z_m, moved[:, 1] / z_m), axis=1) - 0.5
        share: Float64[ndarray, "n 2"] = (predicted - self.matched.pixels) / camera.width_px
        return share

    def equations(self, change: Change, fitted: slice) -> tuple[Float64[ndarray, "p p"], Float64[ndarray, " p"]]:
        """Return information and gradient of the mean point by the fitted parameters."""
        residual = self.residual(change)
        steps = _STEP * np.eye(len(change))[fitted]
        columns = [(self.residual(change + step) - self.residual(change - step)).ravel() for step in steps]
        jacobian = np.stack(columns, axis=1) / (2.0 * _STEP)
        weights = np.repeat(robust_weights(np.linalg.norm(residual, axis=1), _LEAST_STD), 2) / len(residual)
        weighted = jacobian * weights[:, None]
        return weighted.T @ jacobian, -(weighted.T @ residual.ravel())


def _changed(camera: Camera, change: Change) -> Camera:
    fx_px, fy_px = np.exp(change[:2]) * (camera.fx_px, camera.fy_px)
    cx_px, cy_px = camera.width_px * change[2:4] + (camera.cx_px, camera.cy_px)
    return replace(camera, fx_px=float(fx_px), fy_px=float(fy_px), cx_px=float(cx_px), cy_px=float(cy_px))


@dataclass(frozen=True, slots=True)
class RigFit:
    """What fits far better than what is stated, in words, and the median distance that is left.

    words: empty if the change is within the limits of right recordings. T_body_camera: the mount, if it is what fits.
    """

    words: str
    distance: float
    T_body_camera: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    def is_better_than(self, intrinsics: RigFit | None) -> bool:
        """Return True for a mount that leaves less than other intrinsics do, clearly, as it has more parameters."""
        if intrinsics is None:
            return True
        return self.distance < (_CLEAR_GAIN if intrinsics.words else _MOUNT_GAIN) * intrinsics.distance


def fit_intrinsics(motions: Sequence[PointMotion], width_px: int, limits: Limits) -> RigFit | None:
    """Return the intrinsics that fit far better than the stated ones; None if none do.

    width_px: of the recorded images, whose pixels are named.
    """
    change, std = _fit(motions, _CAMERA)
    distance = _clear_distance(motions, change)
    if distance is None or np.abs(change[:2]).max() > _MAX_FOCAL_CHANGE:
        return None
    parts = []
    ratio, ratio_std = change[0] - change[1], math.hypot(std[0], std[1])
    if abs(ratio) > max(limits.ratio, _CERTAIN_STDS * ratio_std):
        axis = int(np.argmax(np.abs(change[:2])))
        parts.append(f"focal length f{'xy'[axis]} {_multiplied(change[axis])}")
    elif abs(change[:2].mean()) > max(limits.focal, _CERTAIN_STDS * std[:2].max()):
        parts.append(f"focal length {_multiplied(change[:2].mean())}")
    if (np.abs(change[2:4]) > np.maximum(limits.centre, _CERTAIN_STDS * std[2:4])).any():
        x_px, y_px = width_px * change[2:4]
        parts.append(f"principal point moved by ({x_px:.0f}, {y_px:.0f}) px")
    words = f"the camera's {' and '.join(parts)} (intrinsics of another size or camera)"
    return RigFit(words if parts else "", distance)


def fit_mount(motions: Sequence[PointMotion]) -> RigFit | None:
    """Return the mount that fits far better than poses of the camera itself; None if none does."""
    change, std = _fit(motions, _MOUNT)
    distance = _clear_distance(motions, change)
    sizes = np.linalg.norm(change[_MOUNT].reshape(2, 3), axis=1)
    limits = np.maximum((_LEAST_MOUNT_M, math.radians(_LEAST_MOUNT_DEG)), _CERTAIN_STDS * std.reshape(2, 3).max(axis=1))
    if distance is None:
        return None
    place = f"turned by {math.degrees(sizes[1]):.0f} degrees and {sizes[0]:.2f} m beside it"
    words = f"poses of another link than the camera, which is {place},"
    return RigFit(words if (sizes > limits).any() else "", distance, transform_of(change[_MOUNT]))


def _multiplied(change: float) -> str:
    factor = math.exp(change)
    return f"multiplied by {factor:.2g}" if factor > 1 else f"divided by {1 / factor:.2g}"


def _clear_distance(motions: Sequence[PointMotion], change: Change) -> float | None:
    """Return the median distance with the change; None if it is not far smaller than the stated one."""
    before, after = (
        float(np.median([np.median(np.linalg.norm(motion.residual(value), axis=1)) for motion in motions]))
        for value in (np.zeros(len(change)), change)
    )
    return after if after < min(_MAX_DISTANCE_SHARE * before, before - _LEAST_GAIN) else None


def _fit(motions: Sequence[PointMotion], fitted: slice) -> tuple[Change, Float64[ndarray, " p"]]:
    """Return the change that fits best, and the standard errors of the fitted parameters by the jackknife."""
    change, precision = np.zeros(len(_PRIOR_STD)), np.diag(1.0 / np.square(_PRIOR_STD[fitted]))
    for _ in range(_STEPS):
        systems = [motion.equations(change, fitted) for motion in motions]
        informations, gradients = (_POINTS_OF_PAIR * np.array(part) for part in zip(*systems, strict=True))
        information, gradient = informations.sum(axis=0), gradients.sum(axis=0)
        update = np.linalg.solve(information + precision, gradient - precision @ change[fitted])
        change[fitted] += np.clip(update, -_LONGEST_STEP, _LONGEST_STEP)
    pull, count = precision @ change[fitted], len(motions)
    without = np.array(
        [
            np.linalg.solve(information - informations[k] + precision, gradient - gradients[k] - pull)
            for k in range(count)
        ]
    )
    return change, np.sqrt((count - 1) / count * np.square(without - without.mean(axis=0)).sum(axis=0))
