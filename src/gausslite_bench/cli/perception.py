"""`gausslite bench perception`: accuracy of a detector's masks after each stage of perception."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.plain_values import split_names
from gausslite.config.program import Program
from gausslite.datasets.regions import balls_for_small_objects, load_voxel_regions
from gausslite.datasets.source import frame_size, select_frames
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.domain.relevance import Region
from gausslite.mission.build import chosen_detector
from gausslite.mission.recording import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    stated_values,
)
from gausslite.mission.settings import PerceptionSettings, SourceSettings
from gausslite.nouns import head_of
from gausslite_bench.perception.stage_scores import PerceptionBench, TaskQuery
from gausslite_bench.report import Report
from gausslite_language.rules import RuleParser


@dataclass(frozen=True, slots=True)
class PerceptionBenchOptions:
    """The options of `bench perception` beside those of the source and the detector."""

    roi: Path | None = option(None, "ground-truth regions (default: the source's own)", metavar="FILE.npz")
    task: tuple[str, ...] = option(
        (),
        "a task and the objects of its target, none for an absent one; repeatable (default: a search for each kind of "
        "object)",
        metavar="TEXT=A,B",
        repeats=True,
    )
    threads: int | None = option(None, "the detector's threads (default: the runtime's choice)", low=1)


def add_perception_options(parser: CommandParser) -> None:
    """Add the options of `bench perception`."""
    Program.of(
        *(PerceptionBenchOptions, RecordingOptions, SourceSettings, PerceptionSettings),
        flags="detector frames size roi task",
        positional="source",
        omit=("test-every", "camera-correction", "pose-prior"),
    ).add_to(parser)


def run_perception(options: argparse.Namespace) -> Report:
    """Run every task on every frame and return the scores of each stage."""
    detector = chosen_detector(build(PerceptionSettings, options, threads=options.threads))
    if detector is None:
        raise InvalidInputError("--detector: expected a model file to compare with ground truth, got none")
    # registered depth; nothing else is estimated
    stated = stated_values(options.register_depth, CameraCorrection(), PoseExposurePrior())
    source = calibrate_with_messages(options.source, open_recorded(options.source, options.up), stated).source
    positions, size = select_frames(source, options.frames), frame_size(options.size, source)
    regions = source.regions()
    if options.roi is not None:
        regions = balls_for_small_objects(load_voxel_regions(options.roi))
    bench = PerceptionBench(detector, _task_queries(options.task, regions), regions, source.up_axis)
    for position in positions:
        bench.process(source.frame(position, size))
    return Report({"tasks": [asdict(score) for score in bench.scores()]})


def _task_queries(texts: Sequence[str], regions: Mapping[str, Region]) -> list[TaskQuery]:
    """Return the given tasks, or a search for every kind of object: mug_1 and mug_2 are of kind mug."""
    parser = RuleParser()
    if texts:
        parts = [text.rpartition("=") for text in texts]
        for text, (task, _, _) in zip(texts, parts, strict=True):
            if not task:
                raise InvalidInputError(
                    f"--task: expected a task and its objects such as 'Find the mug=mug_1', got {text!r}"
                )
        return [TaskQuery(parser.parse(task), split_names(objects)) for task, _, objects in parts]
    kinds: dict[str, list[str]] = {}
    for name in regions:
        kinds.setdefault(head_of(name), []).append(name)
    return [TaskQuery(parser.parse(f"Find the {kind}"), tuple(objects)) for kind, objects in kinds.items()]
