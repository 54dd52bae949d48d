"""Refuse options that do nothing, because the option that they belong to is missing."""

from __future__ import annotations

import argparse

from gausslite.config.values import NONE
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.motion_model import MotionModel
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.mission.settings import PoseMode
from gausslite.perception.detector import DEFAULT_TILES_PER_SIDE
from gausslite.task.backends import RESPONSE_FORMATS, Backend

_DETECTOR, _RATE, _FUSION = "--detector FILE.onnx", "--rate HZ", "--fusion ADDRESS"
_MODEL, _HTTP = "--backend onnx or http", "--backend http"


def require_effect(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for an option that differs from its default and has no effect without another one.

    options: those of `add_policy`, `add_budget` and `add_detector`. The default itself is accepted, because
    `--print-config` prints it.
    """
    if options.poses != str(PoseMode.TRACK) and options.track_motion != str(MotionModel.VELOCITY):
        _refuse("--track-motion", f"--poses {PoseMode.TRACK}")
    if options.rate is None:
        _require_default_schedule(options)
    if options.detector is not None:
        return
    if options.segmenter is not None:
        _refuse("--segmenter", _DETECTOR)
    if options.vocabulary is not None:
        _refuse("--vocabulary", _DETECTOR)
    if options.tiles != DEFAULT_TILES_PER_SIDE:
        _refuse("--tiles", _DETECTOR)


def _require_default_schedule(options: argparse.Namespace) -> None:
    defaults = SchedulerSettings()
    if options.min_iterations != defaults.min_iterations:
        _refuse("--min-iterations", _RATE)
    if options.skip_stages != defaults.skip_stages:
        _refuse("--skip-stages", _RATE)
    if options.deadline_slack != defaults.deadline_slack:
        _refuse("--deadline-slack", _RATE)


def require_fusion_server(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for an option of `gausslite-agent` that has no effect without a fusion server.

    The default itself is accepted, as in `require_effect`.
    """
    if options.fusion is not None:
        return
    values = {
        "--spool": options.spool is not None,
        "--handover": options.handover,
        "--keyframes": bool(options.keyframes),
        "--team-map": options.team_map != NONE,
    }
    for flag, is_set in values.items():
        if is_set:
            _refuse(flag, _FUSION)


def require_language_model(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for an option of `add_backend` that the chosen backend does not use."""
    backend = Backend(options.backend)
    if backend is not Backend.HTTP:
        if options.llm_url is not None:
            _refuse("--llm-url", _HTTP)
        if options.llm_format != RESPONSE_FORMATS[0]:
            _refuse("--llm-format", _HTTP)
    if backend is Backend.RULES and options.llm_model is not None:
        _refuse("--llm-model", _MODEL)


def _refuse(flag: str, needed: str) -> None:
    raise InvalidInputError(f"{flag}: has an effect only with {needed}; give both, or omit {flag}")
