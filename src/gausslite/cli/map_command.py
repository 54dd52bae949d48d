"""`gausslite map`: one sequence, one task, one map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.cli.mapping_run import MappingRun, Mission
from gausslite.cli.parse_command import as_json
from gausslite.cli.source_options import (
    add_regions,
    add_source,
    asked_regions,
    open_recorded,
    register_with_warnings,
    resolve_pose_prior,
)
from gausslite.config.mapping_options import add_budget, add_detector, add_policy, mission_settings, perception_settings
from gausslite.config.values import AUTO, NONE, read_depth_registration, read_pose_prior
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.task import TaskGraph
from gausslite.errors import DatasetError, InvalidInputError
from gausslite.evaluation.pictures import write_png
from gausslite.evaluation.preview import render_preview
from gausslite.evaluation.views import MapViewer
from gausslite.mapping.policies import TASK
from gausslite.mission.build import RelevanceEstimatorFactory, build_estimator, build_mapper
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.results import PREVIEW, peak_rss_mib, prepare_beside, prepare_folder, write_results
from gausslite.mission.settings import MissionSettings, SceneInfo
from gausslite.mission.task_mapper import TaskMapper
from gausslite.mission.task_schedule import TaskSchedule, TaskSwitch
from gausslite.perception.fixed_relevance import NoTaskEstimator, RegionRelevanceEstimator
from gausslite.perception.relevance_estimator import RelevanceEstimator
from gausslite.render.choose import choose_rasterizer


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite map`."""
    add_source(parser, default_text=AUTO)
    parser.add_argument(
        "--task", metavar="TEXT", help='what the robot is to do, such as "Pick up the mug on the table"'
    )
    parser.add_argument(
        "--task-at",
        metavar="FRAME:TASK",
        action="append",
        default=[],
        help="another task from this frame number on; may be repeated",
    )
    add_detector(parser)
    add_regions(parser)
    add_policy(parser, allow_auto=True)
    add_budget(parser)
    parser.add_argument("--test-every", metavar="N", type=int, help="keep every Nth frame from mapping, for `eval`")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="gets map.ply, report.json and preview.png"
    )
    add = parser.add_argument_group("save and resume").add_argument
    add("--save-state", metavar="FILE", type=Path, help="save the whole run here at its end, to go on with --resume")
    add("--resume", metavar="FILE", type=Path, help="go on from a saved run, with the frames after its last one")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Map the sequence and write the results; whatever can be told before the work is."""
    asked = _Asked.of(options)
    saved = None if options.resume is None else SavedRun.read(options.resume)
    if saved is not None:
        asked = asked.as_saved(options, saved)
    prepare_folder(options.out)
    if options.save_state is not None:
        prepare_beside(options.save_state, options.out)
    last_index = -1 if saved is None else saved.last_index
    graph = asked.plan.at(last_index)
    recorded = asked.source
    attentions = RelevanceEstimatorFactory(perception_settings(options), lambda: SceneInfo.of(recorded))
    attention = _region_attention(options, recorded) if graph is None else attentions.to(graph)
    if saved is None:
        asked = asked.looked_at(options)
    mapper = TaskMapper(
        attention, build_mapper(asked.settings), scheduler=FrameScheduler(asked.settings.scheduler_settings)
    )
    if saved is not None:
        saved.restore(mapper)
        saved = None  # as large as the map and its keyframes, and copied
    mission = MappingRun(asked.source, asked.size, mapper, asked.plan, attentions).play(asked.after(last_index), graph)
    if not mission.outcomes and mission.stopped is not None:
        raise mission.stopped
    gaussians = mapper.gaussians()
    if len(gaussians) == 0 and mission.outcomes and all(each.skipped is not None for each in mission.outcomes):
        raise DatasetError(f"{options.source}: expected frames with depth, got none in {len(mission.outcomes)}")
    notes = (*mapper.notes, *_unseen(options, mission))
    report = {**asked.report(options), **mission.summary(), **_held(mapper, gaussians), "notes": list(notes)}
    write_results(options.out, gaussians, report)
    if mapper.keyframes():
        viewer = MapViewer(gaussians, choose_rasterizer(asked.settings.backend, asked.settings.threads))
        write_png(options.out / PREVIEW, render_preview(viewer, mapper.keyframes()))
    if options.save_state is not None:
        last_index = mission.outcomes[-1].index if mission.outcomes else last_index
        save_run(options.save_state, mapper, asked.terms(options, last_index), last_index)
    if mission.stopped is not None:
        # what was mapped until then is kept, and the exit code says that it is not all
        raise mission.stopped
    skipped = f" ({report['frames_skipped']} skipped, without depth)" if report["frames_skipped"] else ""
    print(
        f"{report['frames']} frames{skipped} at {report['hz']:.1f} Hz, {len(gaussians)} Gaussians "
        f"({report['active_gaussians']} of the task) → {options.out / 'map.ply'}; look at {PREVIEW} beside it"
    )
    for note in notes:
        print(f"  {note}")
    return 0


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the command line asks for, as far as it can be known without drawing, loading or training anything.

    Views are trusted and frames are as recorded until the sequence is looked at, which takes seconds.
    """

    settings: MissionSettings
    source: Source
    positions: Sequence[int]
    size: tuple[int, int]
    plan: TaskSchedule
    depth_registration: DepthRegistration | None

    @classmethod
    def of(cls, options: argparse.Namespace) -> _Asked:
        settings = mission_settings(options)
        plan = _plan(asked_task(options), [TaskSwitch.parse(text) for text in options.task_at])
        source = open_recorded(options.source, options.up)
        positions, size = select_frames(source, options.frames), frame_size(options.size, source)
        if options.test_every is not None:
            positions, _ = HeldOutSplit(options.test_every).split(positions)
        return cls(settings, source, positions, size, plan, None)

    def looked_at(
        self,
        options: argparse.Namespace,
        camera: DepthRegistration | str | None = None,
        pose_prior: PoseExposurePrior | None = None,
    ) -> _Asked:
        """With the camera and trust that are asked for, or given here; what is neither is looked for in the frames."""
        given = options.register_depth if camera is None else camera
        source, registered_to = register_with_warnings(options.source, self.source, given, AUTO)
        believed = resolve_pose_prior(options.source, source, options.pose_prior if pose_prior is None else pose_prior)
        settings = replace(self.settings, pose_prior=believed)
        return replace(self, settings=settings, source=source, depth_registration=registered_to)

    def as_saved(self, options: argparse.Namespace, saved: SavedRun) -> _Asked:
        """looked_at, where what was found is that of a saved run. Raises MismatchError where it had other terms."""
        camera, pose_prior = None, None
        if options.register_depth in (None, AUTO):
            camera = read_depth_registration(saved.terms.options.get("colour_camera") or NONE)
        if options.pose_prior == AUTO:
            pose_prior = read_pose_prior(saved.terms.options.get("view_error") or NONE)
        asked = self.looked_at(options, camera, pose_prior)
        saved.require(asked.terms(options, saved.last_index))
        return asked

    def terms(self, options: argparse.Namespace, last_index: int) -> ResumeConfig:
        """What must be the same when a run goes on after the frame of this number."""
        graph = self.plan.at(last_index)
        return ResumeConfig.of(
            self.settings,
            size=f"{self.size[0]}x{self.size[1]}",
            task="" if graph is None else graph.text,
            colour_camera="" if self.depth_registration is None else str(self.depth_registration),
            up="" if options.up is None else ",".join(map(str, options.up)),
            **{name: _file_name(getattr(options, name)) for name in ("detector", "segmenter", "vocabulary", "roi")},
            resegment="yes" if options.resegment else "",
            objects=",".join(options.objects),
            hold_out="" if options.test_every is None else str(options.test_every),
            roi_ball=" ".join(f"{','.join(map(str, ball.centre_m))},{ball.radius_m}" for ball in options.roi_ball),
        )

    def after(self, index: int) -> list[int]:
        """The positions of the frames with greater numbers."""
        indices = self.source.indices()
        return [position for position in self.positions if indices[position] > index]

    def report(self, options: argparse.Namespace) -> dict[str, object]:
        """As a part of the report."""
        first = self.plan.first
        return {
            "source": options.source,
            "colour_camera": None if self.depth_registration is None else str(self.depth_registration),
            "view_error": None if self.settings.pose_prior.is_exact else str(self.settings.pose_prior),
            "task": None if first is None else {"text": first.text, **as_json(first)},
            "then": [{"frame": frame, "text": later.text, **as_json(later)} for frame, later in self.plan.turns],
            "policy": options.policy,
            "without": sorted(self.settings.disabled),
            "size": list(self.size),
            "seed": self.settings.seed,
            "max_gaussians": self.settings.max_gaussians,
            "hold_out": options.test_every,
            "resumed_from": None if options.resume is None else str(options.resume),
        }


def _file_name(path: Path | str | None) -> str:
    """Where it lies may change between two runs."""
    return "" if path is None else Path(path).name


def _unseen(options: argparse.Namespace, mission: Mission) -> tuple[str, ...]:
    """What to tell of a task, or of regions of space, of which nothing was ever seen."""
    if any(outcome.roi_share > 0 for outcome in mission.outcomes):
        return ()
    if options.task is not None:
        return ("nothing that the task is about was found in any of these frames",)
    if not (options.roi or options.objects or options.roi_ball):
        return ()
    return ("none of these frames shows the region that was asked for; is it of another sequence, or in other units?",)


def _held(mapper: TaskMapper, gaussians: Gaussians) -> dict[str, object]:
    """What the map holds, and what it takes."""
    return {
        "gaussians": len(gaussians),
        "active_gaussians": int(gaussians.active.sum()),
        "peak_rss_mib": peak_rss_mib(),
        "memory_mib": mapper.memory_mib(),
    }


def _plan(first: TaskGraph | None, turns: Sequence[TaskSwitch]) -> TaskSchedule:
    """The tasks of --task and --task-at."""
    if not turns:
        return TaskSchedule(first)
    if first is None:
        raise InvalidInputError("--task-at: follows a task in words; give the first with --task TEXT")
    from gausslite.task.rules import RuleParser

    return TaskSchedule(first, tuple((turn.frame, RuleParser().parse(turn.text)) for turn in turns))


def asked_task(options: argparse.Namespace) -> TaskGraph | None:
    """The task in words, None where regions of space (or nothing, for a uniform map) take its place.

    Raises InvalidInputError for options that contradict each other, TaskError.
    """
    regions = options.roi is not None or options.objects or options.roi_ball
    if options.task is not None and regions:
        raise InvalidInputError("--task: give either a task in words, or regions with --roi or --roi-ball, not both")
    if options.detector is not None and options.task is None:
        raise InvalidInputError("--detector: finds the nouns of a task; give the task with --task TEXT")
    if options.task is None:
        if not regions and options.policy == TASK:
            raise InvalidInputError(
                "--task: expected a task in words, or regions with --roi FILE.npz or --roi-ball X,Y,Z,R"
            )
        return None
    from gausslite.task.rules import RuleParser

    return RuleParser().parse(options.task)


def choose_attention(options: argparse.Namespace, source: Source) -> tuple[RelevanceEstimator, TaskGraph | None]:
    """A task in words, or regions of space, or (for a uniform map) nothing to attend to."""
    graph = asked_task(options)
    if graph is None:
        return _region_attention(options, source), None
    return build_estimator(graph, SceneInfo.of(source), perception_settings(options)), graph


def _region_attention(options: argparse.Namespace, source: Source) -> RelevanceEstimator:
    regions = asked_regions(options, source)
    return RegionRelevanceEstimator(regions) if regions else NoTaskEstimator()
