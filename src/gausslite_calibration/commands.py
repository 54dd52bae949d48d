"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

CALIBRATE: Final = Command(
    "estimate the camera of a recording: depth registration, lens, rolling shutter, times, pose errors",
    "gausslite_calibration.calibrate_command",
)
