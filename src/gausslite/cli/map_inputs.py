"""Collect and check the inputs of `gausslite map` before it maps anything."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from typing import Any

from gausslite.cli.source_options import calibrate_with_messages, open_recorded, stated_values
from gausslite.codec.json import graph_as_json
from gausslite.config.option import build, option
from gausslite.config.task_parser import DefaultParser
from gausslite.config.values import AUTO, NONE
from gausslite.datasets.calibration import StatedValues
from gausslite.datasets.open import default_world_frame, open_source
from gausslite.datasets.source import Source, frame_step
from gausslite.domain.errors import DatasetError, GaussLiteError, InvalidInputError, PoseError
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.domain.state import get_text
from gausslite.domain.task import TaskGraph
from gausslite.mission.checkpoint import SavedRun
from gausslite.mission.prior_map import PriorMap
from gausslite.mission.runner import FrameStream
from gausslite.mission.schedule import TaskSchedule, TaskSwitch
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    PoseMode,
    SourceSettings,
    TaskSettings,
    default_policy,
)
from gausslite.process import print_message

FRAMES_KEY = "frames"
"""Name of the text of --frames among the extra arrays of a saved run."""


@dataclass(frozen=True, slots=True)
class _Sequence:
    """The sequence of a saved run: a folder may move, but it must keep its name."""

    name: str = option(MISSING, "name of the sequence", key="SOURCE")


@dataclass(frozen=True, slots=True)
class MapInputs:
    """The settings of one run, its frames and its tasks.

    Depth registration and pose prior are not estimated yet, see `calibrated` and `resumed`. sequence: world frame of
    the recording, which `in_frame_of` does not change. notes: on poses or depth that contradict the images.
    """

    mission: MissionSettings
    perception: PerceptionSettings
    source: SourceSettings
    task: TaskSettings
    stream: FrameStream
    schedule: TaskSchedule
    sequence: str
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, options: argparse.Namespace) -> MapInputs:
        """Return the inputs of the command line. Raises InvalidInputError, DatasetError, TaskError."""
        task = build(TaskSettings, options)
        mission = mission_settings(options)
        schedule = _schedule(parse_task(options), [TaskSwitch.parse(text) for text in options.task_at])
        require_poses = mission.poses is not PoseMode.TRACK
        recorded = _open_recorded(options, require_poses)
        source = build(
            SourceSettings, options, depth_registration=None, camera_correction=None, require_poses=require_poses
        )
        stream = FrameStream.select(recorded, source)
        source = replace(source, size=f"{stream.size[0]}x{stream.size[1]}")
        if options.policy is None and options.task is None and not has_regions(options):
            print_message("no --task and no region: mapping everything equally (--policy uniform)")
        perception = build(PerceptionSettings, options).at_rate(mission)
        return cls(mission, perception, source, task, stream, schedule, recorded.world_frame)

    def calibrated(self, stated: StatedValues) -> MapInputs:
        """Return the inputs with registration, correction and prior: those stated, else guaranteed or estimated."""
        recorded, poses = self.stream.source, self.mission.poses
        if poses is PoseMode.TRACK:
            stated = replace(stated, checked=True)  # given poses are not used
        if poses is PoseMode.TRACK and stated.correction is None:
            # readout time and offset are estimated from given poses
            stated = replace(stated, correction=CameraCorrection(recorded.lens))
        if poses is not PoseMode.REFINE and stated.pose_prior is None:
            stated = replace(stated, pose_prior=PoseExposurePrior())
        found = calibrate_with_messages(self.source.spec, recorded, stated)
        mission = replace(self.mission, pose_prior=found.pose_prior)
        correction = None if found.correction.is_identity else found.correction
        return replace(
            self,
            mission=replace(mission, pose_prior=mission.refinement_prior),
            source=replace(self.source, depth_registration=found.registration, camera_correction=correction),
            stream=replace(self.stream, source=found.source),
            notes=found.notes,
        )

    def resumed(self, options: argparse.Namespace, saved: SavedRun) -> MapInputs:
        """Return the inputs with the saved run's registration and prior where they would be estimated.

        Raises MismatchError if other options differ from the saved run's.
        """
        registration = options.register_depth
        if registration in (None, AUTO):
            registration = saved.value(SourceSettings, "depth_registration") or NONE
        correction = options.camera_correction
        if correction in (None, AUTO):
            correction = saved.value(SourceSettings, "camera_correction") or CameraCorrection()
        pose_prior = options.pose_prior
        if pose_prior == AUTO:
            pose_prior = saved.value(MissionSettings, "pose_prior")
        inputs = self.calibrated(replace(stated_values(registration, correction, pose_prior), checked=True))
        saved.require(*inputs.fixed_settings(saved.last_index))
        _report_other_step(saved, self.source.frames)
        return inputs

    def in_frame_of(self, prior: PriorMap) -> MapInputs:
        """Return the inputs with the sequence in the world frame of the map that the run continues."""
        return replace(self, stream=replace(self.stream, source=prior.moved(self.stream.source)))

    def fixed_settings(self, last_index: int) -> tuple[Any, ...]:
        """Return the settings that a run must have to continue after this frame."""
        graph = self.schedule.at(last_index)
        task = replace(self.task, task=None if graph is None else graph.text)
        return self.mission, self.perception, self.source, task, _Sequence(self.sequence)

    def world_frame(self, options: argparse.Namespace) -> str:
        """Return the name of the world frame: that of the options, else the sequence's."""
        stated = options.world_frame
        return default_world_frame(self.stream.source) if stated is None else str(stated)

    def report(self) -> dict[str, object]:
        """Return the inputs as part of the report."""
        first = self.schedule.first
        registration, correction = self.source.depth_registration, self.source.camera_correction
        prior = self.mission.pose_prior
        return {
            "source": self.source.spec,
            "up": list(self.stream.source.up_axis),
            "colour_camera": None if registration is None else str(registration),
            "camera_correction": None if correction is None else str(correction),
            "view_error": None if prior.is_exact else str(prior),
            "task": None if first is None else {"text": first.text, **graph_as_json(first)},
            "then": [
                {"frame": frame, "text": graph.text, **graph_as_json(graph)} for frame, graph in self.schedule.switches
            ],
            "poses": str(self.mission.poses),
            "policy": self.mission.policy,
            "without": sorted(self.mission.disabled),
            "size": list(self.stream.size),
            "seed": self.mission.seed,
            "max_gaussians": self.mission.max_gaussians,
            "hold_out": self.source.test_every,
            "selected_frames": self.source.frames,
        }


def mission_settings(options: argparse.Namespace) -> MissionSettings:
    """Return the mapping's settings; a pose prior that is still to be estimated counts as exact."""
    prior = options.pose_prior if isinstance(options.pose_prior, PoseExposurePrior) else PoseExposurePrior()
    return build(MissionSettings, options, policy=options.policy or policy_of(options), pose_prior=prior)


def parse_task(options: argparse.Namespace) -> TaskGraph | None:
    """Return the task; None for regions and a uniform map. Raises InvalidInputError for a contradiction, TaskError."""
    regions = has_regions(options)
    if options.task is not None and regions:
        raise InvalidInputError("--task: give either a task, or regions with --roi, --objects or target-at, not both")
    if options.detector is not None and options.task is None:
        raise InvalidInputError("--detector: it finds the nouns of a task; give the task with --task TEXT")
    if options.task is None:
        if options.policy is not None and not regions and MissionSettings(policy=options.policy).follows_task:
            raise InvalidInputError(
                f"--policy {options.policy}: expected a task, with --task TEXT, or regions, with --roi FILE.npz or "
                "--set target-at=X,Y,Z[,R]"
            )
        return None
    return DefaultParser().parse(options.task)


def _open_recorded(options: argparse.Namespace, require_poses: bool) -> Source:
    """Open the sequence; where its poses cannot be read, the error says that frames without poses can be tracked."""
    try:
        source = open_recorded(options.source, options.up, require_poses)
    except (DatasetError, PoseError) as error:
        raise _with_advice(error, options, require_poses) from None
    first = _error_of(source, 0) if require_poses else None
    if first is not None and all(_error_of(source, i) for i in (len(source) // 2, len(source) - 1)):
        advised = _with_advice(first, options, require_poses)
        if advised is not first:
            raise advised
    return source


def _error_of(source: Source, position: int) -> GaussLiteError | None:
    try:
        source.frame(position)
    except (DatasetError, PoseError) as error:
        return error
    return None


def _with_advice(error: GaussLiteError, options: argparse.Namespace, require_poses: bool) -> GaussLiteError:
    """Return the error with the option that maps frames without poses, if it would; the error itself if not."""
    if not require_poses:
        return error
    try:
        open_source(options.source, options.up, require_poses=False).frame(0)
    except (DatasetError, PoseError):
        return error
    return type(error)(f"{error}; --poses {PoseMode.TRACK} maps the frames without given poses")


def has_regions(options: argparse.Namespace) -> bool:
    """Return True if the options select regions of space."""
    return bool(options.roi is not None or options.objects or options.target_at)


def _report_other_step(saved: SavedRun, frames: str) -> None:
    """Print a message if the saved run took frames with another step."""
    if FRAMES_KEY not in saved.extra:
        return
    before, now = frame_step(get_text(saved.extra, FRAMES_KEY)), frame_step(frames)
    if before != now:
        print_message(f"--frames: the saved run has a step of {before} frames, this one of {now}")


def policy_of(options: argparse.Namespace) -> str:
    """Return the policy that is used without --policy: "task" with a task or a region, else "uniform"."""
    return default_policy(options.task is not None or has_regions(options))


def _schedule(first: TaskGraph | None, switches: Sequence[TaskSwitch]) -> TaskSchedule:
    """Return the schedule of the task and task-at. Raises InvalidInputError, TaskError."""
    if not switches:
        return TaskSchedule(first)
    if first is None:
        raise InvalidInputError("task-at: expected a first task, with --task TEXT, got none")
    frames = [switch.frame for switch in switches]
    for frame in frames:
        if frames.count(frame) > 1:
            raise InvalidInputError(f"task-at: expected one task for a frame, got {frames.count(frame)} for {frame}")
    return TaskSchedule(first, tuple((switch.frame, DefaultParser().parse(switch.text)) for switch in switches))
