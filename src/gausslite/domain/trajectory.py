"""A camera's poses over time, and its velocity at a time."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import inverse, twist_of

_MIN_BASELINE_S = 1e-6
_TYPICAL_DISTANCE_M = 2.0
_MAX_VELOCITY_CHANGE = 0.5
_MAX_GAP_RATIO = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Twist:
    """A camera's velocity in its own axes: T_world_camera(t + dt) ≈ T_world_camera(t) · exp(dt · twist)."""

    linear_m_s: Float64[ndarray, "3"]
    angular_rad_s: Float64[ndarray, "3"]

    @property
    def typical_image_speed(self) -> float:
        """Image motion in focal lengths per second, of a point at a distance of 2 m."""
        return float(np.linalg.norm(self.angular_rad_s) + np.linalg.norm(self.linear_m_s) / _TYPICAL_DISTANCE_M)

    def motion(self, seconds: float) -> Float64[ndarray, "4 4"]:
        """Return T_before_after of this motion for a time, to first order in the translation."""
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(self.angular_rad_s * seconds)[0]
        T[:3, 3] = self.linear_m_s * seconds
        return T


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses at ascending times. Raises ShapeError, InvalidInputError."""

    times_s: Float64[ndarray, " n"]
    T_world_camera: Float64[ndarray, "n 4 4"]

    def __post_init__(self) -> None:
        require_array("trajectory T_world_camera", self.T_world_camera, (len(self.times_s), 4, 4), np.float64)
        if not (np.isfinite(self.times_s).all() and (np.diff(self.times_s) >= 0).all()):
            raise InvalidInputError("trajectory times_s: expected finite, ascending times")

    def twist(self, i: int) -> Twist:
        """Return the velocity at pose i; 0 if the trajectory has a single time.

        It is the derivative of the polynomial through two poses on each side, or of the line through the nearest ones
        at the ends of the trajectory and beside gaps. A line alone underestimates the peaks of a hand-held camera.
        """
        before, after = max(i - 1, 0), min(i + 1, len(self.times_s) - 1)
        if self.times_s[after] - self.times_s[before] < _MIN_BASELINE_S:
            return Twist(np.zeros(3), np.zeros(3))
        neighbours = [i - 2, i - 1, i + 1, i + 2]
        if not self._is_evenly_spaced(neighbours):
            neighbours = [before, after]
        times_s = self.times_s[neighbours] - self.times_s[i]
        T_camera_neighbour = inverse(self.T_world_camera[i]) @ self.T_world_camera[neighbours]
        turns_rad = np.stack([cv2.Rodrigues(T[:3, :3])[0].ravel() for T in T_camera_neighbour])
        weights = _derivative_weights(times_s)
        return Twist(weights @ T_camera_neighbour[:, :3, 3], weights @ turns_rad)

    def _is_evenly_spaced(self, neighbours: list[int]) -> bool:
        """True if these poses exist, and no gap between them or to pose i is over twice as long as another."""
        if neighbours[0] < 0 or neighbours[-1] >= len(self.times_s):
            return False
        gaps_s = np.diff(self.times_s[neighbours[0] : neighbours[-1] + 1])
        return bool(gaps_s.min() >= _MIN_BASELINE_S and gaps_s.max() <= _MAX_GAP_RATIO * gaps_s.min())

    def is_steady(self, i: int) -> bool:
        """True if the velocities before and after pose i are similar: only then do the poses state the velocity there.

        False for the first and the last pose.
        """
        if not 0 < i < len(self.times_s) - 1:
            return False
        before, after = (self._mean_velocity(first) for first in (i - 1, i))
        change, mean = after - before, 0.5 * (before + after)
        limit = _MAX_VELOCITY_CHANGE * Twist(mean[:3], mean[3:]).typical_image_speed
        return Twist(change[:3], change[3:]).typical_image_speed <= limit

    def _mean_velocity(self, i: int) -> Float64[ndarray, "6"]:
        """Return translation and rotation per second from pose i to the next."""
        seconds = max(float(self.times_s[i + 1] - self.times_s[i]), _MIN_BASELINE_S)
        return twist_of(inverse(self.T_world_camera[i]) @ self.T_world_camera[i + 1]) / seconds

    def angular_speeds_rad_s(self) -> Float64[ndarray, " n"]:
        """Return the magnitude of the angular velocity at every pose."""
        return np.array([np.linalg.norm(self.twist(i).angular_rad_s) for i in range(len(self.times_s))])


def _derivative_weights(times_s: Float64[ndarray, " k"]) -> Float64[ndarray, " k"]:
    """Return the weights of values at these times in the derivative at 0 of the polynomial through them and (0, 0).

    Two times of which one is 0 give the line through both, and two others the line through them.
    """
    weights: Float64[ndarray, " k"]
    if len(times_s) == 2:
        weights = np.array([-1.0, 1.0]) / (times_s[1] - times_s[0])
    else:
        powers = times_s[:, None] ** np.arange(1, len(times_s) + 1)
        weights = np.linalg.solve(powers.T, np.eye(len(times_s))[0])
    return weights
