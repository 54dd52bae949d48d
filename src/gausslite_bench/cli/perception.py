"""`gausslite bench perception`: what a detector's masks are worth, before and after they are placed and followed."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.source_options import add_source, open_with_warnings
from gausslite.config.mapping_options import add_detector
from gausslite.config.values import read_names
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.region import Region
from gausslite.errors import InvalidInputError
from gausslite.evaluation.pictures import write_png
from gausslite.mission.results import as_text, prepare_folder
from gausslite.perception.vocabulary import head_of, same_kind
from gausslite.task.rules import RuleParser
from gausslite_bench.perception.contact_sheet import PerceptionSheet
from gausslite_bench.perception.stage_scores import PerceptionBench, Question, QuestionScore

_COLUMNS = ("IoU", "precision", "recall", "marked, %", "most, %", "frames", "right", "found", "late")


def configure_perception(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench perception`."""
    add_source(parser)
    add_detector(parser)
    add = parser.add_argument_group("benchmark").add_argument
    add("--roi", metavar="FILE.npz", type=Path, help="ground-truth regions (default: the source's own)")
    add(
        "--task",
        metavar="TEXT=A,B",
        action="append",
        default=[],
        help="a task and the objects it is about; may be repeated (default: a search for each kind of object)",
    )
    add("--absent", metavar="A,B", type=read_names, default=(), help="nouns of which nothing is there: what do they mark?")
    add("--threads", metavar="N", type=int, help="the detector's threads (default: the runtime's choice)")
    add("--pictures", metavar="DIR", type=Path, help="write a sheet for each task here")
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_perception)


def run_perception(options: argparse.Namespace) -> int:
    """Ask every task of every frame and print each step's figures."""
    from gausslite.perception.model_registry import ModelRegistry

    if options.detector is None:
        raise InvalidInputError("--detector: expected a model file, since ground truth has nothing to be measured by")
    source, _ = open_with_warnings(options.source, options.up, options.register_depth)
    positions, size = select_frames(source, options.frames), frame_size(options.size, source)
    regions = _regions(options, source)
    questions = [*_asked(options.task, regions), *_absent(options.absent, regions)]
    if options.pictures is not None:
        prepare_folder(options.pictures)
    networks = ModelRegistry(options.detector, options.segmenter, options.vocabulary, options.threads)
    segmenter = networks.segmenter if options.resegment else None
    bench = PerceptionBench(networks.detector, questions, regions, source.up_axis, segmenter)
    sheets = [PerceptionSheet(len(positions)) for _ in questions] if options.pictures is not None else []
    for position in positions:
        marks = bench.look(source.frame(position, size))
        for sheet, each in zip(sheets, marks, strict=False):
            sheet.offer(each)
    for number, sheet in enumerate(sheets, start=1):
        write_png(options.pictures / f"task-{number}.png", sheet.draw())
    command = shlex.join(["gausslite", *sys.argv[1:]])
    if options.json:
        print(as_text({"command": command, "tasks": [asdict(score) for score in bench.scores()]}))
    else:
        print(f"`{command}`\n\n{perception_table(bench.scores())}")
    return 0


def perception_table(scores: Sequence[QuestionScore]) -> str:
    """A row for each step of each task; what can not be said is left blank."""
    lines = [f"| task | step | {' | '.join(_COLUMNS)} |", "|---|---" + "|---:" * len(_COLUMNS) + "|"]
    for score in scores:
        asked = ", ".join(score.objects) or "nothing"
        title = f"{score.task} ({asked}; shown in {score.shown_frames} of {score.frames} frames)"
        for step, figures in score.steps.items():
            there = bool(score.objects)
            cells = (
                *(_shown(value, 3) for value in (figures.iou, figures.precision, figures.recall)),
                f"{100 * figures.marked_mean:.2f}",
                f"{100 * figures.marked_most:.2f}",
                f"{figures.marked_frames}",
                f"{figures.right_frames}" if there else "",
                f"{figures.objects_found} of {score.shown_objects}" if there else "",
                _shown(figures.late_frames, 1),
            )
            lines.append(f"| {title} | {step} | {' | '.join(cells)} |")
            title = ""
    return "\n".join(lines)


def _shown(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _regions(options: argparse.Namespace, source: Source) -> Mapping[str, Region]:
    from gausslite.datasets.regions import balls_for_small_objects, load_voxel_regions

    return source.regions() if options.roi is None else balls_for_small_objects(load_voxel_regions(options.roi))


def _asked(texts: Sequence[str], regions: Mapping[str, Region]) -> list[Question]:
    """The given tasks, or a search for every kind of object: mug_1 and mug_2 are the kind mug."""
    parser = RuleParser()
    if texts:
        parts = [text.rpartition("=") for text in texts]
        for text, (task, _, _) in zip(texts, parts, strict=True):
            if not task:
                raise InvalidInputError(
                    f"--task: expected a task and its objects such as 'Find the mug=mug_1', got {text!r}"
                )
        return [Question(parser.parse(task), read_names(objects)) for task, _, objects in parts]
    kinds: dict[str, list[str]] = {}
    for name in regions:
        kinds.setdefault(head_of(name), []).append(name)
    return [Question(parser.parse(f"Find the {kind}"), tuple(objects)) for kind, objects in kinds.items()]


def _absent(nouns: Sequence[str], regions: Mapping[str, Region]) -> list[Question]:
    for noun in nouns:
        there = [name for name in regions if same_kind(noun, name)]
        if there:
            raise InvalidInputError(
                f"--absent: expected nouns that name nothing there, got {noun}, which is {there[0]}"
            )
    return [Question(RuleParser().parse(f"Find the {noun}"), ()) for noun in nouns]
