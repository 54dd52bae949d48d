"""Which step of an odometry no robot makes: too far for the time, after too long a time, or back in time."""

from __future__ import annotations

import numpy as np

from gausslite.domain.frame import Frame
from gausslite.domain.pose import require_rigid, rotation_angle_deg, translation_m
from gausslite.domain.state import State, get_array, get_counts, get_floats, int_array

_STEP_M, _SPEED_M_S = 0.5, 3.0
_STEP_DEG, _SPEED_DEG_S = 60.0, 180.0
_GAP_S = 5.0
_USUAL = 3.0
"""A step is as usual up to this multiple of the longest one so far: recordings without times have any frame rate."""
_MIN_STEPS = 5


class OdometrySteps:
    """The steps between the frames of one odometry. Not thread-safe."""

    def __init__(self) -> None:
        self._time_ns, self._T_odometry_camera = np.zeros(1, np.int64), np.eye(4)
        self._steps = 0
        # of the steps so far: metres, degrees, seconds
        self._longest = np.zeros(3)
        self._is_restored = False

    def add(self, frame: Frame) -> tuple[str, bool]:
        """Add the next frame. Returns why its step is none of a robot, or nothing; and whether it is only late."""
        previous_ns, T_previous = int(self._time_ns[0]), self._T_odometry_camera
        self._time_ns, self._T_odometry_camera = np.array([frame.capture_time_ns]), frame.T_world_camera
        moved_m, turned_deg = (
            measure(T_previous, frame.T_world_camera) for measure in (translation_m, rotation_angle_deg)
        )
        step_s = (frame.capture_time_ns - previous_ns) / 1e9
        step = np.array([moved_m, turned_deg, step_s])
        # between two processes, the odometry has gone on, or has begun anywhere
        moving_s, self._is_restored = 0.0 if self._is_restored else max(step_s, 0.0), False
        fixed = np.array([_STEP_M + _SPEED_M_S * moving_s, _STEP_DEG + _SPEED_DEG_S * moving_s, _GAP_S])
        self._steps += 1
        if self._steps <= _MIN_STEPS:
            # the first frame makes no step
            self._longest = np.maximum(self._longest, step) if self._steps > 1 else self._longest
            return "", False
        if step_s < 0:
            return f"the clock went back by {-step_s:.1f} s", False
        too_long = step > np.maximum(fixed, _USUAL * self._longest)
        if too_long[:2].any():
            return f"the odometry jumped by {moved_m:.2f} m and {turned_deg:.0f} degrees", False
        if too_long[2]:
            return f"no frame came for {step_s:.1f} s", True
        self._longest = np.maximum(self._longest, step)
        return "", False

    def state(self) -> State:
        """Return the newest frame's time and pose, and the longest steps."""
        return {
            "time_ns": self._time_ns,
            "pose": self._T_odometry_camera,
            "steps": int_array(self._steps),
            "longest": self._longest,
        }

    def restore(self, state: State) -> None:
        """Continue from another object's state. Raises MapFileError, PoseError."""
        T_odometry_camera = get_array(state, "pose", (4, 4), np.float64)
        require_rigid("state monitor pose", T_odometry_camera)
        self._T_odometry_camera = T_odometry_camera.copy()
        self._time_ns = get_array(state, "time_ns", (1,), np.int64).copy()
        self._is_restored = True
        [self._steps] = get_counts(state, "steps", 1)
        self._longest = np.array(get_floats(state, "longest", 3))
