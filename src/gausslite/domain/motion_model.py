"""The choice of what predicts a tracked camera's motion."""

from __future__ import annotations

from enum import StrEnum


class MotionModel(StrEnum):
    """What predicts the motion since the last frame where features do not."""

    VELOCITY = "velocity"
    """The velocity between the last two frames."""
    ODOMETRY = "odometry"
    """The motion between the poses of the frames."""
