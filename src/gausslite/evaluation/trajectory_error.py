"""Absolute trajectory error (ATE): position error of a trajectory after its best rigid alignment to the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.trajectory import Trajectory

_MAX_TIME_GAP_S = 1e-3
_MIN_POSES = 3


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """ATE over the poses at common times (Sturm et al. 2012), aligned in SE(3), without scale."""

    rmse_m: float
    max_m: float
    poses: int


def trajectory_error(estimated: Trajectory, reference: Trajectory) -> TrajectoryError | None:
    """Return the ATE of the estimated trajectory; None with fewer than 3 poses at times of the reference (± 1 ms)."""
    if min(len(estimated.times_s), len(reference.times_s)) == 0:
        return None
    after = np.clip(np.searchsorted(reference.times_s, estimated.times_s), 1, max(len(reference.times_s) - 1, 1))
    candidates = np.stack([after - 1, np.minimum(after, len(reference.times_s) - 1)])
    gaps_s = np.abs(reference.times_s[candidates] - estimated.times_s)
    nearest = candidates[np.argmin(gaps_s, axis=0), np.arange(len(estimated.times_s))]
    matched = gaps_s.min(axis=0) <= _MAX_TIME_GAP_S
    if np.count_nonzero(matched) < _MIN_POSES:
        return None
    positions_m = estimated.T_world_camera[matched][:, :3, 3]
    true_m = reference.T_world_camera[nearest[matched]][:, :3, 3]
    errors_m = np.linalg.norm(_aligned(positions_m, true_m) - true_m, axis=1)
    return TrajectoryError(float(np.sqrt(np.mean(np.square(errors_m)))), float(errors_m.max()), len(errors_m))


def _aligned(points: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """Return the points after the rotation and translation that minimise their squared distances (Umeyama 1991)."""
    mean, target_mean = points.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - mean).T @ (target - target_mean))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    aligned: Float64[ndarray, "n 3"] = (points - mean) @ (Vt.T @ mirror @ U.T).T + target_mean
    return aligned
