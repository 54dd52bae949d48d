"""`gausslite bench loop`: the frame rate that an agent's mapping loop keeps, and the time of each stage."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from gausslite.cli.map_command import mission_settings, parse_task
from gausslite.cli.progress import MappingBar
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import Program
from gausslite.datasets.source import Source, frame_size, select_frames
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.policies import TASK
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.build import EstimatorFactory, build_mapper, region_estimator
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.recording import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    selected_regions,
    stated_values,
)
from gausslite.mission.results import peak_rss_mib
from gausslite.mission.runner import FrameStream, MissionRunner
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    SceneInfo,
    SourceSettings,
    TaskSettings,
)
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import RelevanceEstimator
from gausslite_bench.frame_costs import loop_figures
from gausslite_bench.report import Report

_HOME = "sim:home?seed=0&trajectory=0"
_HOME_TASK = "Pick up the mug on the table"


def add_loop_options(parser: CommandParser) -> None:
    """Add the options of `bench loop`."""
    Program.of(
        *(RecordingOptions, SourceSettings, TaskSettings, PerceptionSettings, MissionSettings),
        flags="frames size task detector roi objects policy max-gaussians iterations rate seed",
        positional="source",
        omit=("test-every",),
        defaults={"source": _HOME},
    ).add_to(parser)


def run_loop(options: argparse.Namespace) -> Report:
    """Map the sequence and return the time of each stage. Reading frames is not counted."""
    has_task = options.task or options.roi or options.objects or options.target_at
    if options.source == _HOME and options.policy == TASK and not has_task:
        options.task = _HOME_TASK
    stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
    calibration = calibrate_with_messages(options.source, open_recorded(options.source, options.up), stated)
    source, options.pose_prior = calibration.source, calibration.pose_prior
    positions = select_frames(source, options.frames)
    figures = _map_frames(options, source, positions)
    values = {
        "source": options.source,
        "task": options.task,
        "size": list(frame_size(options.size, source)),
        "rate": options.rate,
        **figures,
        "frames_skipped": len(positions) - int(str(figures["frames"])),
        "peak_rss_mib": peak_rss_mib(),
    }
    return Report(values)


def _estimator(options: argparse.Namespace, source: Source) -> RelevanceEstimator:
    """Return the relevance estimator of the options: for a task, for regions, or for a uniform map."""
    graph = parse_task(options)
    if graph is None:
        return region_estimator(
            selected_regions(options.source, source, options.roi, options.objects, options.target_at)
        )
    perception = build(PerceptionSettings, options).at_rate(mission_settings(options))
    return EstimatorFactory(perception, lambda: SceneInfo.of(source)).build(graph)


def _map_frames(options: argparse.Namespace, source: Source, positions: Sequence[int]) -> dict[str, object]:
    """Return the figures of the frames at these positions."""
    settings = mission_settings(options)
    scheduler = FrameScheduler(settings.scheduler_settings)
    mapper = TaskMapper(_estimator(options, source), build_mapper(settings), SentVoxelTracker(VoxelGrid()), scheduler)
    mapped: list[FrameOutcome] = []

    def record(outcome: FrameOutcome) -> None:
        if outcome.skipped is None:
            mapped.append(outcome)
        bar.count(outcome)

    frames = FrameStream(source, positions, frame_size(options.size, source)).frames()
    with MappingBar(len(positions), "bench") as bar:
        MissionRunner(mapper.process, record).run(frames).raise_if_stopped()
    return loop_figures(mapped)
