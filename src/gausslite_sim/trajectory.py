"""Camera trajectories: splines through waypoints of eye positions and look-at targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite_sim.mesh import Vector


@runtime_checkable
class TrajectorySampler(Protocol):
    """Returns poses T_world_camera along a path (z up; OpenCV camera axes, no roll)."""

    def __call__(self, frames: int, numbers: Float64[ndarray, " n"] | None = None) -> Float64[ndarray, "n 4 4"]:
        """Return the poses of `frames` frames, evenly spaced along the path.

        numbers: return the poses at these frame numbers instead, which may be fractions.
        """
        ...


Waypoint = tuple[Vector, Vector]
"""(eye position, look-at target) in metres."""


def spline_trajectory(keys: Sequence[Waypoint]) -> TrajectorySampler:
    """Return the trajectory from the first waypoint to the last."""
    waypoints = np.array(keys)

    def poses(frames: int, numbers: Float64[ndarray, " n"] | None = None) -> Float64[ndarray, "n 4 4"]:
        if frames == 1:
            share = np.full(1 if numbers is None else len(numbers), 0.5)
        else:
            share = np.linspace(0.0, 1.0, frames) if numbers is None else numbers / (frames - 1)
        return look_at_poses(_spline(waypoints[:, 0], share), _spline(waypoints[:, 1], share))

    return poses


def walked_laps(path: TrajectorySampler, laps: int) -> TrajectorySampler:
    """Return the trajectory that follows the path so many times, every second time backwards."""

    def poses(frames: int, numbers: Float64[ndarray, " n"] | None = None) -> Float64[ndarray, "n 4 4"]:
        walked = laps * (np.arange(frames, dtype=np.float64) if numbers is None else numbers)
        lap, place = np.divmod(walked, max(frames - 1, 1))
        return path(frames, np.where(lap % 2 == 0, place, frames - 1 - place))

    return path if laps == 1 else poses


def look_at_poses(eyes_m: Float64[ndarray, "n 3"], targets_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 4 4"]:
    """Return T_world_camera of cameras at the eyes that look at the targets."""
    return np.stack([_look_at(eye, target) for eye, target in zip(eyes_m, targets_m, strict=True)])


def _spline(keys: Float64[ndarray, "k 3"], share: Float64[ndarray, " n"]) -> Float64[ndarray, "n 3"]:
    """Return points of the Catmull-Rom spline through the keys at these shares of its parameter range."""
    padded = np.concatenate([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1]])
    parameter = share * (len(keys) - 1)
    i = np.minimum(parameter.astype(np.int64), len(keys) - 2)
    t = (parameter - i)[:, None]
    p0, p1, p2, p3 = (padded[i + k] for k in range(4))
    doubled = 2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3
    return np.asarray(0.5 * doubled)


def _look_at(eye_m: Float64[ndarray, "3"], target_m: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    forward = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    x, y, z = forward.tolist()
    right = np.array([y, -x, 0.0])
    right /= np.linalg.norm(right)
    # products in the order of np.cross, which takes ten times longer for single vectors
    right_x, right_y, right_z = right.tolist()
    down = (y * right_z - z * right_y, z * right_x - x * right_z, x * right_y - y * right_x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = right, down, forward
    T[:3, 3] = eye_m
    return T
