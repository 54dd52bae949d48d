"""`gausslite bench perception`: accuracy of a detector's masks after each stage of perception."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gausslite.cli.source_options import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    stated_values,
)
from gausslite.codec.state_file import write_png
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.plain_values import split_names
from gausslite.config.program import Program
from gausslite.datasets.source import Source, frame_size, select_frames
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import NounMatch
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.domain.relevance import Region
from gausslite.mission.build import chosen_detector
from gausslite.mission.results import as_text, prepare_folder
from gausslite.mission.settings import PerceptionSettings, SourceSettings
from gausslite.nouns import head_of, same_kind
from gausslite.perception.detector import Detector
from gausslite_bench.perception.absent_nouns import AbsentSummary, absent_queries, choose_absent_nouns
from gausslite_bench.perception.contact_sheet import PerceptionSheet
from gausslite_bench.perception.stage_scores import PerceptionBench, PerceptionStage, TaskQuery, TaskScore
from gausslite_language.rules import RuleParser

_ANY_OBJECT = "object"
_COLUMNS = ("IoU", "precision", "recall", "marked, %", "max, %", "frames", "right", "found", "late")


def read_absent(text: str) -> tuple[str, ...] | int:
    """Return the nouns of "a,b", or the number of nouns to choose."""
    return int(text) if text.isdecimal() else split_names(text)


@dataclass(frozen=True, slots=True)
class PerceptionBenchOptions:
    """The options of `bench perception` beside those of the source and the detector."""

    roi: Path | None = option(None, "ground-truth regions (default: the source's own)", metavar="FILE.npz")
    task: tuple[str, ...] = option(
        (),
        "a task and the objects of its target; repeatable (default: a search for each kind of object)",
        metavar="TEXT=A,B",
        repeats=True,
    )
    absent: tuple[str, ...] | int = option(
        (),
        "also search for these nouns, which must be absent, or for N nouns of the detector's vocabulary",
        metavar="A,B|N",
        plain_type=str,
        convert=read_absent,
    )
    present: tuple[str, ...] = option(
        (), "objects of the scene without ground truth: --absent N searches for none of them", metavar="A,B"
    )
    threads: int | None = option(None, "the detector's threads (default: the runtime's choice)", low=1)
    pictures: Path | None = option(None, "write a contact sheet for each task to this folder", metavar="DIR")
    json: bool = option(False, "print JSON for scripts")


def configure_perception(parser: CommandParser) -> None:
    """Add the options of `bench perception`."""
    Program.of(
        *(PerceptionBenchOptions, RecordingOptions, SourceSettings, PerceptionSettings),
        flags="detector frames size roi task absent present pictures json",
        positional="source",
        omit=("test-every", "camera-correction", "pose-prior"),
    ).add_to(parser)
    parser.set_defaults(run=run_perception)


def run_perception(options: argparse.Namespace) -> int:
    """Run every task on every frame and print the scores of each stage."""
    detector = chosen_detector(build(PerceptionSettings, options, threads=options.threads))
    if detector is None:
        raise InvalidInputError("--detector: expected a model file to compare with ground truth, got none")
    source = _open(options)
    positions, size = select_frames(source, options.frames), frame_size(options.size, source)
    regions = _regions(options, source)
    absent = _absent_queries(options, detector, regions)
    queries = [*_task_queries(options.task, regions), *absent]
    if options.pictures is not None:
        prepare_folder(options.pictures)
    bench = PerceptionBench(detector, queries, regions, source.up_axis)
    sheets = [PerceptionSheet(len(positions)) for _ in queries] if options.pictures is not None else []
    for position in positions:
        masks = bench.process(source.frame(position, size))
        for sheet, task_masks in zip(sheets, masks, strict=False):
            sheet.add(task_masks)
    for number, sheet in enumerate(sheets, start=1):
        write_png(options.pictures / f"task-{number}.png", sheet.draw())
    matches = detector.matches([noun for query in absent for noun in query.graph.queries])
    _print_scores(bench.scores(), matches, options.json)
    return 0


def _open(options: argparse.Namespace) -> Source:
    """Return the source with registered depth; nothing else is estimated."""
    stated = stated_values(options.register_depth, CameraCorrection(), PoseExposurePrior())
    return calibrate_with_messages(options.source, open_recorded(options.source, options.up), stated).source


def _print_scores(scores: Sequence[TaskScore], absent: Sequence[NounMatch], as_json: bool) -> None:
    """Print the scores; of searches for absent nouns, the table has those that mark a pixel. absent: their matches."""
    command = shlex.join(["gausslite", *sys.argv[1:]])
    summary = AbsentSummary.from_scores(scores, absent)
    if as_json:
        print(as_text({"command": command, "tasks": [asdict(s) for s in scores], "absent": asdict(summary)}))
        return
    shown = [s for s in scores if s.objects or any(stage.marked_frames for stage in s.stages.values())]
    print(f"`{command}`\n\n{perception_table(shown)}\n\n{object_table(shown)}")
    if summary.nouns:
        print(f"\n{summary.describe()}")


def perception_table(scores: Sequence[TaskScore]) -> str:
    """Return a Markdown table with one row per task and stage; undefined scores are blank."""
    lines = [f"| task | stage | {' | '.join(_COLUMNS)} |", "|---|---" + "|---:" * len(_COLUMNS) + "|"]
    for score in scores:
        objects = ", ".join(score.objects) or "nothing"
        title = f"{score.task} ({objects}; shown in {score.shown_frames} of {score.frames} frames)"
        for stage, stage_score in score.stages.items():
            has_objects = bool(score.objects)
            cells = (
                *(_format(value, 3) for value in (stage_score.iou, stage_score.precision, stage_score.recall)),
                f"{100 * stage_score.marked_mean:.2f}",
                f"{100 * stage_score.marked_max:.2f}",
                f"{stage_score.marked_frames}",
                f"{stage_score.right_frames}" if has_objects else "",
                f"{stage_score.objects_found} of {score.shown_objects}" if has_objects else "",
                _format(stage_score.late_frames, 1),
            )
            lines.append(f"| {title} | {stage} | {' | '.join(cells)} |")
            title = ""
    return "\n".join(lines)


def object_table(scores: Sequence[TaskScore]) -> str:
    """Return a Markdown table with one row per object: how often it is detected, and its recall from then on."""
    stages = " | ".join(f"recall {stage}" for stage in PerceptionStage)
    lines = [
        f"| task | object | frames | detected, % | {stages} |",
        "|---|---" + "|---:" * (2 + len(PerceptionStage)) + "|",
    ]
    for score in scores:
        for object_score in score.object_scores:
            recalls = " | ".join(_format(object_score.recall[stage], 2) for stage in PerceptionStage)
            detected = f"{100 * object_score.detected_share:.0f}"
            lines.append(
                f"| {score.task} | {object_score.name} | {object_score.shown_frames} | {detected} | {recalls} |"
            )
    return "\n".join(lines)


def _format(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _regions(options: argparse.Namespace, source: Source) -> Mapping[str, Region]:
    from gausslite.datasets.regions import balls_for_small_objects, load_voxel_regions

    return source.regions() if options.roi is None else balls_for_small_objects(load_voxel_regions(options.roi))


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


def _absent_queries(options: argparse.Namespace, detector: Detector, regions: Mapping[str, Region]) -> list[TaskQuery]:
    """Return a search for each noun of --absent, or for as many nouns of the detector's vocabulary."""
    if isinstance(options.absent, int):
        from gausslite_detectors.class_match import TextEmbeddings

        embeddings = TextEmbeddings.from_model_folder(options.detector)
        vocabulary = () if embeddings is None else tuple(embeddings.noun_index)
        (every,) = detector.matches((_ANY_OBJECT,))
        return absent_queries(
            choose_absent_nouns(every.classes, vocabulary, [*regions, *options.present], options.absent)
        )
    for noun in options.absent:
        matches = [name for name in regions if same_kind(noun, name)]
        if matches:
            raise InvalidInputError(
                f"--absent: expected nouns of absent objects, got {noun}, which matches {matches[0]}"
            )
    return absent_queries(options.absent)
