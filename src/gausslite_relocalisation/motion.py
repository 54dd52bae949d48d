"""Which step of an odometry no robot makes: the images show another, it is too far, too late, or back in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, require_rigid, rotation_angle_deg, translation_m
from gausslite.domain.state import State, get_array, get_counts, get_floats, int_array
from gausslite_calibration.consistency import match_pair
from gausslite_calibration.live_check import FrameWindow, compared
from gausslite_relocalisation.image_motion import refined_by_images

_STEP_M, _SPEED_M_S = 0.5, 3.0
_STEP_DEG, _SPEED_DEG_S = 60.0, 180.0
_GAP_S = 5.0
_USUAL = 3.0
"""A step is as usual up to this multiple of the longest one so far: recordings without times have any frame rate."""
_JUMP_RATIO, _LEAST_JUMP_M, _LEAST_JUMP_DEG = 4.0, 0.3, 15.0
"""A step this much longer than the median, and this long, is compared with the images. Odometry that slips by less is
refined, and corrected at loops."""
_UNSHOWN = 0.6
"""Error of the points by the odometry, as a share of their motion, with which too few matches to measure another motion
do not show this one either."""
_MIN_STEPS, _MAX_STEPS = 6, 30
_SAME_PLACE_M, _SAME_PLACE_DEG = 0.2, 8.0
"""Poses that differ less from those by the images agree again: a jump is measured to a few centimetres."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a step is not the robot's motion. is_continued: the odometry keeps its frame: it is late or jumped back."""

    cause: str
    is_continued: bool = False


class OdometrySteps:
    """The steps between the frames of one odometry. Not thread-safe.

    T_before_now: from the odometry to the one before its jumps, as the images show it; None if they do not.
    """

    def __init__(self) -> None:
        self._time_ns, self._T_odometry_camera = np.zeros(1, np.int64), np.eye(4)
        self._count = 0
        # of the steps so far: metres, degrees, seconds
        self._longest, self._recent = np.zeros(3), np.zeros((0, 2))
        # none after a restart
        self._last: Frame | None = None
        self.T_before_now: Float64[ndarray, "4 4"] | None = np.eye(4)

    def add(self, frame: Frame) -> Doubt | None:
        """Add the next frame. Returns why its step is none of a robot; None for one that a robot makes."""
        previous_ns, T_previous = int(self._time_ns[0]), self._T_odometry_camera
        last, self._last = self._last, compared(frame)
        self._time_ns, self._T_odometry_camera = np.array([frame.capture_time_ns]), frame.T_world_camera
        self._count += 1
        if self._count == 1:
            return None
        moved_m, turned_deg = (
            measure(T_previous, frame.T_world_camera) for measure in (translation_m, rotation_angle_deg)
        )
        step = np.array([moved_m, turned_deg, (frame.capture_time_ns - previous_ns) / 1e9])
        if step[2] < 0:
            self.T_before_now = None
            return Doubt(f"the clock went back by {-step[2]:.1f} s")
        jump = self._jump(step, last, self._last)
        self._recent = np.concatenate([self._recent, step[None, :2]])[-_MAX_STEPS:]
        if jump is not None:
            return jump
        is_late = self._count > _MIN_STEPS and step[2] > max(_GAP_S, _USUAL * self._longest[2])
        if is_late:
            return Doubt(f"no frame came for {step[2]:.1f} s", is_continued=self._is_back(frame))
        self._longest = np.maximum(self._longest, step)
        return None

    def begin(self, is_followed: bool) -> None:
        """Count jumps from now on. is_followed: False for a robot that has moved without its odometry."""
        self.T_before_now = np.eye(4) if is_followed else None

    def state(self) -> State:
        """Return the newest frame's time and pose, and the steps so far; the newest image is not saved."""
        known = np.zeros((0, 4, 4)) if self.T_before_now is None else self.T_before_now[None]
        return {
            "time_ns": self._time_ns,
            "pose": self._T_odometry_camera,
            "steps": int_array(self._count),
            "longest": self._longest,
            "recent": self._recent,
            "before": known,
        }

    def restore(self, state: State) -> None:
        """Continue from another object's state. Raises MapFileError, PoseError."""
        T_odometry_camera = get_array(state, "pose", (4, 4), np.float64)
        require_rigid("state monitor pose", T_odometry_camera)
        self._T_odometry_camera = T_odometry_camera.copy()
        self._time_ns = get_array(state, "time_ns", (1,), np.int64).copy()
        [self._count] = get_counts(state, "steps", 1)
        self._longest = np.array(get_floats(state, "longest", 3))
        self._recent = get_array(state, "recent", (None, 2), np.float64).copy()
        before = get_array(state, "before", (None, 4, 4), np.float64)
        self.T_before_now = before[0].copy() if len(before) else None
        self._last = None

    def _jump(self, step: Float64[ndarray, "3"], last: Frame | None, frame: Frame) -> Doubt | None:
        """Return why a step is a jump: the images show another motion, or it is too far where they show none."""
        # between two processes, the odometry has gone on, or has begun anywhere
        moving_s = 0.0 if last is None else step[2]
        farthest = np.array([_STEP_M + _SPEED_M_S * moving_s, _STEP_DEG + _SPEED_DEG_S * moving_s])
        is_too_far = bool((step[:2] > np.maximum(farthest, _USUAL * self._longest[:2])).any())
        if self._count <= _MIN_STEPS or not (is_too_far or self._is_long(step[:2])):
            return None
        pair = None
        if last is not None and last.camera == frame.camera:
            pair = match_pair(FrameWindow((last, frame)), 0, 1)
        by_odometry = np.eye(4) if last is None else inverse(frame.T_world_camera) @ last.T_world_camera
        is_contradicted = pair is not None and pair.contradicts(by_odometry)
        if pair is None or (is_too_far and not is_contradicted and pair.errors(by_odometry[None])[0] > _UNSHOWN):
            if is_too_far:
                self.T_before_now = None
            return Doubt(f"the odometry jumped by {_text(step)}") if is_too_far else None
        if last is None or not is_contradicted:
            return None
        T_last_frame = refined_by_images(last, frame, inverse(pair.matched.T_current_reference))
        if self.T_before_now is not None:
            T_last_now = last.T_world_camera @ T_last_frame @ inverse(frame.T_world_camera)
            self.T_before_now = self.T_before_now @ T_last_now
        shown_m = float(np.linalg.norm(T_last_frame[:3, 3]))
        cause = f"the odometry jumped by {_text(step)}, and the images show {shown_m:.2f} m"
        return Doubt(cause, self._is_back(frame))

    def _is_back(self, frame: Frame) -> bool:
        """True if the pose is the one by the images since before the first jump."""
        if self.T_before_now is None:
            return False
        T = self.T_before_now @ frame.T_world_camera
        moved_m, turned_deg = translation_m(T, frame.T_world_camera), rotation_angle_deg(T, frame.T_world_camera)
        return moved_m < _SAME_PLACE_M and turned_deg < _SAME_PLACE_DEG

    def _is_long(self, step: Float64[ndarray, "2"]) -> bool:
        longest = _JUMP_RATIO * np.median(self._recent, axis=0)
        return bool((step > np.maximum(longest, (_LEAST_JUMP_M, _LEAST_JUMP_DEG))).any())


def _text(step: Float64[ndarray, "3"]) -> str:
    return f"{step[0]:.2f} m and {step[1]:.0f} degrees"
