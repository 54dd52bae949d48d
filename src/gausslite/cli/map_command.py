"""`gausslite map`: one sequence, one task, one map."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gausslite.cli.arguments import add_regions, add_source, asked_regions
from gausslite.cli.parse_command import as_json
from gausslite.cli.progress import MappingBar
from gausslite.datasets.open import open_source
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.task import TaskGraph
from gausslite.errors import GaussLiteError, InvalidInputError
from gausslite.interrupts import AfterThisStep
from gausslite.mapping.pace import Pace
from gausslite.mapping.policies import TASK
from gausslite.mission.build import Attentions, build_attention, build_mapper
from gausslite.mission.options import add_budget, add_detector, add_policy, mission_settings, perception_settings
from gausslite.mission.results import peak_rss_mib, prepare_file, prepare_folder, write_results
from gausslite.mission.saved_run import last_frame, resume_run, save_run
from gausslite.mission.settings import SceneKnowledge
from gausslite.mission.turns import TaskPlan, Turn
from gausslite.perception.attention import Attention
from gausslite.perception.fixed import NoAttention, RegionAttention
from gausslite.pipeline import FrameOutcome, TaskMapper


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite map`."""
    add_source(parser)
    parser.add_argument(
        "--task", metavar="TEXT", help='what the robot is to do, such as "Pick up the mug on the table"'
    )
    parser.add_argument(
        "--then",
        metavar="FRAME:TASK",
        action="append",
        default=[],
        help="another task from this frame number on; may be repeated",
    )
    add_detector(parser)
    add_regions(parser)
    add_policy(parser)
    add_budget(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="gets map.ply and report.json")
    add = parser.add_argument_group("save and resume").add_argument
    add("--save-state", metavar="FILE", type=Path, help="save the whole run here at its end, to go on with --resume")
    add("--resume", metavar="FILE", type=Path, help="go on from a saved run, with the frames after its last one")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Map the sequence and write the results."""
    settings = mission_settings(options)
    turns = [Turn.parse(text) for text in options.then]
    source = open_source(options.source, options.up, options.colour_camera)
    positions = select_frames(source, options.frames)
    size = frame_size(options.size, source)
    attention, first = choose_attention(options, source)
    plan, attentions = _plan(first, turns), Attentions(SceneKnowledge.of(source), perception_settings(options))
    graph = first if options.resume is None or not plan.turns else plan.at(last_frame(options.resume))
    if graph is not None and graph is not first:
        attention = attentions.to(graph)
    mapper = TaskMapper(attention, build_mapper(settings), pace=Pace(settings.pace))
    prepare_folder(options.out)
    if options.save_state is not None:
        prepare_file(options.save_state)
    last_index = -1
    if options.resume is not None:
        last_index = resume_run(options.resume, mapper, graph)
        positions = [position for position in positions if source.indices()[position] > last_index]
    mission = _Player(source, size, mapper, plan, attentions).play(positions, graph)
    if mission.outcomes:
        last_index = mission.outcomes[-1].index
    elif mission.stopped is not None:
        raise mission.stopped
    gaussians = mapper.gaussians()
    active = int(gaussians.active.sum())
    report = {
        "source": options.source,
        "colour_camera": None if options.colour_camera is None else str(options.colour_camera),
        "task": None if first is None else {"text": first.text, **as_json(first)},
        "then": [{"frame": frame, "text": later.text, **as_json(later)} for frame, later in plan.turns],
        "policy": options.policy,
        "without": sorted(settings.without),
        "size": list(size),
        "seed": settings.seed,
        **mission.summary(),
        "gaussians": len(gaussians),
        "active_gaussians": active,
        "max_gaussians": settings.max_gaussians,
        "resumed_from": None if options.resume is None else str(options.resume),
        "peak_rss_mib": peak_rss_mib(),
        "memory_mib": mapper.memory_mib(),
        "notes": list(mapper.notes),
    }
    write_results(options.out, gaussians, report)
    if options.save_state is not None:
        save_run(options.save_state, mapper, plan.at(last_index), last_index)
    if mission.stopped is not None:
        # what was mapped until then is kept, and the exit code says that it is not all
        raise mission.stopped
    print(
        f"{report['frames']} frames at {report['hz']:.1f} Hz, {len(gaussians)} Gaussians "
        f"({active} of the task) → {options.out / 'map.ply'}"
    )
    return 0


@dataclass(frozen=True, slots=True)
class _Mission:
    """The outcomes of all frames, and their time; stopped is the bad frame, or the Ctrl-C, that ended it early."""

    outcomes: tuple[FrameOutcome, ...]
    seconds: float
    stopped: GaussLiteError | KeyboardInterrupt | None

    def summary(self) -> dict[str, object]:
        """Totals for the report; hz is mapped frames per second of perception and mapping, without reading files."""
        mapped = [outcome for outcome in self.outcomes if outcome.skipped is None]
        busy_s = sum(outcome.budget.seconds for outcome in mapped)
        return {
            "frames": len(mapped),
            "frames_skipped": len(self.outcomes) - len(mapped),
            "iterations": sum(outcome.iterations for outcome in mapped),
            "roi_share": sum(outcome.roi_share for outcome in mapped) / max(len(mapped), 1),
            "keyframes_reread": sum(outcome.reread.keyframes for outcome in self.outcomes),
            "seeded_in_keyframes": sum(outcome.reread.seeded for outcome in self.outcomes),
            "hz": len(mapped) / busy_s if busy_s > 0 else 0.0,
            "seconds": self.seconds,
            "stopped_by": None if self.stopped is None else str(self.stopped) or "interrupted",
        }


@dataclass(frozen=True, slots=True)
class _Player:
    """Plays a source to a loop, which is given each task when its turn has come."""

    source: Source
    size: tuple[int, int]
    mapper: TaskMapper
    plan: TaskPlan
    attentions: Attentions

    def play(self, positions: Sequence[int], graph: TaskGraph | None) -> _Mission:
        """Map these frames; graph is the task that the loop has now."""
        started_s = time.perf_counter()
        outcomes: list[FrameOutcome] = []
        stopped: GaussLiteError | KeyboardInterrupt | None = None
        indices = self.source.indices()
        with MappingBar(len(positions)) as bar, AfterThisStep() as interrupt:
            for position in positions:
                if interrupt.asked:
                    stopped = KeyboardInterrupt()
                    break
                try:
                    frame = self.source.frame(position, self.size)
                except GaussLiteError as error:
                    stopped = error
                    break
                graph = self._turn(graph, indices[position])
                outcomes.append(self.mapper.process(frame))
                bar.show(len(outcomes), outcomes[-1].gaussians, outcomes[-1].roi_share)
        return _Mission(tuple(outcomes), time.perf_counter() - started_s, stopped)

    def _turn(self, now: TaskGraph | None, index: int) -> TaskGraph | None:
        """The task of this frame, assigned where it asks for other things than the one before."""
        graph = self.plan.at(index)
        if graph is not None and now is not None and not graph.asks_the_same_as(now):
            self.mapper.assign(self.attentions.to(graph))
        return graph


def _plan(first: TaskGraph | None, turns: Sequence[Turn]) -> TaskPlan:
    """The tasks of --task and --then."""
    if not turns:
        return TaskPlan(first)
    if first is None:
        raise InvalidInputError("--then: follows a task in words; give the first with --task TEXT")
    from gausslite.task.rules import RuleParser

    return TaskPlan(first, tuple((turn.frame, RuleParser().parse(turn.text)) for turn in turns))


def choose_attention(options: argparse.Namespace, source: Source) -> tuple[Attention, TaskGraph | None]:
    """A task in words, or regions of space, or (for a uniform map) nothing to attend to."""
    regions = asked_regions(options, source)
    if options.task is not None and regions:
        raise InvalidInputError("--task: give either a task in words, or regions with --roi or --roi-ball, not both")
    if options.detector is not None and options.task is None:
        raise InvalidInputError("--detector: finds the nouns of a task; give the task with --task TEXT")
    if options.task is not None:
        from gausslite.task.rules import RuleParser

        graph = RuleParser().parse(options.task)
        return build_attention(graph, SceneKnowledge.of(source), perception_settings(options)), graph
    if not regions and options.policy == TASK:
        raise InvalidInputError(
            "--task: expected a task in words, or regions with --roi FILE.npz or --roi-ball X,Y,Z,R"
        )
    return RegionAttention(regions) if regions else NoAttention(), None
