"""Refuse options that do nothing, because the option that they belong to is missing."""

from __future__ import annotations

import argparse

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.motion_model import MotionModel
from gausslite.mission.settings import PoseMode

_DETECTOR = "--detector FILE.onnx"


def require_effect(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for an option that differs from its default and has no effect without another one.

    options: those of `add_policy` and `add_detector`. The default itself is accepted: `--print-config` prints it.
    """
    if options.poses != str(PoseMode.TRACK) and options.track_motion != str(MotionModel.VELOCITY):
        _refuse("--track-motion", f"--poses {PoseMode.TRACK}")
    if options.detector is not None:
        return
    if options.segmenter is not None:
        _refuse("--segmenter", _DETECTOR)
    if options.vocabulary is not None:
        _refuse("--vocabulary", _DETECTOR)
    if options.resegment:
        _refuse("--resegment", _DETECTOR)


def _refuse(flag: str, needed: str) -> None:
    raise InvalidInputError(f"{flag}: has an effect only with {needed}; give both, or omit {flag}")
