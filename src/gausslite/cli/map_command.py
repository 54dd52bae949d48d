"""`gausslite map`: map one sequence, for a task, for regions or uniformly."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.cli.progress import MappingBar, print_above_bar
from gausslite.codec.json import noun_as_json, object_as_json
from gausslite.codec.state_file import write_png
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.program import Program
from gausslite.config.task_parser import DefaultParser
from gausslite.datasets.open import default_world_frame, open_reference
from gausslite.datasets.source import Source
from gausslite.domain.checks import require_name
from gausslite.domain.errors import DatasetError, InvalidInputError, MissingPluginError, PoseError
from gausslite.domain.frame import NO_DEPTH, ONE_COLOUR, TOO_FAR, Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import found_text
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.task import TaskGraph
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.evaluation import Evaluator, TrainingFit
from gausslite.mission.localisation_monitor import UNPLACED, LocalisationState
from gausslite.mission.plan import MappedRun, OpenRun, RunPlan
from gausslite.mission.prior_map import compare_with_prior
from gausslite.mission.recording import RecordingOptions, stated_values
from gausslite.mission.results import (
    MAP,
    PREVIEW,
    locked_folder,
    prepare_folder,
    require_absent,
    require_additional_file,
    write_keyframes,
    write_poses,
    write_results,
)
from gausslite.mission.run_records import RunRecord, open_records
from gausslite.mission.runner import MissionResult
from gausslite.mission.schedule import TaskSchedule
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    PoseMode,
    SourceSettings,
    TaskSettings,
    default_policy,
)
from gausslite.mission.task_mapper import REPEATED, TRACKING_LOST, FrameOutcome
from gausslite.pages import BeginView, load_pages
from gausslite.plugins import Group, load
from gausslite.process import ROBOT_LOST, TASK_NOT_FOUND, DeferredInterrupt
from gausslite.render.map_viewer import view_map
from gausslite.render.rasterizer import Rendering
from gausslite.wire.channel import MAX_PORT

_SKIPS = {
    NO_DEPTH: "without depth",
    ONE_COLOUR: "of one colour",
    TOO_FAR: "too far",
    REPEATED: "repeated",
    TRACKING_LOST: "lost by tracking",
    UNPLACED: "without a known place",
}
_LEAST_DEPTH_M = 0.05
"""No depth camera measures nearer: a smaller median is in another unit."""


def trajectory_report(mapped: MappedRun, evaluator: Evaluator | None) -> dict[str, object]:
    """Return the ATE of the map's trajectory and of the given one, if true poses exist, and the tracking counts.

    evaluator: None leaves out the ATE.
    """
    settings, mapper = mapped.run.plan.source, mapped.mapper
    errors: dict[str, object] = {"ate": None, "given_ate": None, "tracking": dict(mapper.tracking_counts)}
    try:
        reference = open_reference(settings.spec, settings.depth_registration)
        true = None if reference is None else reference.trajectory()
        given = mapped.run.stream.source.trajectory()
    except (DatasetError, PoseError):  # a frame's damaged pose, reported when the frame was read
        return errors
    if true is not None and len(mapper.poses) > 0 and evaluator is not None:
        for name, estimated in (("ate", mapper.poses.trajectory()), ("given_ate", given)):
            error = evaluator.trajectory_error(estimated, true)
            errors[name] = None if error is None else asdict(error)
    return errors


def tracking_text(report: Mapping[str, Any]) -> str:
    """Return how frames were tracked, and the trajectory's error if the sequence has poses to compare with."""
    counts = ", ".join(f"{count} {name}" for name, count in report["tracking"].items() if count)
    ate = report["ate"]
    if ate is None:
        return f"tracking (frames): {counts}; the sequence has no poses to compare with"
    return f"tracking (frames): {counts}; ATE {1e3 * ate['rmse_m']:.1f} mm RMSE over {ate['poses']} poses"


@dataclass(frozen=True, slots=True)
class MapOptions:
    """The options of `gausslite map` beside those of its source, task, perception and mapping."""

    out: Path = option(
        MISSING,
        "folder for map.ply, its history, report.json, frames.csv, keyframes.json, views and preview.png",
        metavar="DIR",
    )
    overwrite: bool = option(False, "replace a map in --out (resume does so without this option)")
    strict: bool = option(False, "end at a frame that cannot be read (default: skip it)")
    task_at: tuple[str, ...] = option(
        (), "switch to another task at this frame number", metavar="FRAME:TASK", repeats=True
    )
    view: int | None = option(
        None,
        "show the map on a page at http://127.0.0.1:PORT while it grows; 0 chooses a port (extra: view)",
        metavar="PORT",
        low=0,
        high=MAX_PORT,
    )
    world_frame: str | None = option(
        None,
        "name of the poses' frame, for `fuse`, which accepts only maps of one frame (default: the sequence folder's "
        "name or the simulated home)",
        metavar="NAME",
    )
    save_state: Path | None = option(None, "save the whole run here at its end, for resume", metavar="FILE")
    resume: Path | None = option(None, "continue a saved run with the frames after its last one", metavar="FILE")
    prior: Path | None = option(
        None,
        "continue the map of an earlier run, in its world frame; its folder, as --out of `map` or an agent",
        metavar="RUN",
    )


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite map`."""
    Program.of(
        *(MapOptions, TaskSettings, RecordingOptions, SourceSettings, PerceptionSettings, MissionSettings),
        flags="task detector frames size max-gaussians iterations rate roi objects policy seed poses test-every out "
        "overwrite prior",
        positional="source",
        defaults={"policy": None},
        computed={"policy": policy_of},
    ).add_to(parser)
    parser.set_defaults(run=run)


def plan_of(options: argparse.Namespace) -> RunPlan:
    """Return what the options map. Raises InvalidInputError for a contradiction, TaskError."""
    mission = mission_settings(options)
    tracks = mission.poses is PoseMode.TRACK
    recorded = {"depth_registration": None, "camera_correction": None, "require_poses": not tracks}
    chooses_nothing = options.policy is None and options.task is None and not has_regions(options)
    stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
    return RunPlan(
        mission,
        build(PerceptionSettings, options).at_rate(mission),
        build(SourceSettings, options, **recorded),
        TaskSchedule.parse(parse_task(options), options.task_at, DefaultParser()),
        build(TaskSettings, options),
        stated=replace(stated, force=options.force),
        can_point=options.view is not None,
        prior=options.prior,
        resume=options.resume,
        notes=("no --task and no region: mapping everything equally (--policy uniform)",) * chooses_nothing,
    )


def mission_settings(options: argparse.Namespace) -> MissionSettings:
    """Return the mapping's settings; a pose prior that is still to be estimated counts as exact."""
    prior = options.pose_prior if isinstance(options.pose_prior, PoseExposurePrior) else PoseExposurePrior()
    return build(MissionSettings, options, policy=options.policy or policy_of(options), pose_prior=prior)


def policy_of(options: argparse.Namespace) -> str:
    """Return the policy that is used without --policy: "task" with a task or a region, else "uniform"."""
    return default_policy(options.task is not None or has_regions(options))


def parse_task(options: argparse.Namespace) -> TaskGraph | None:
    """Return the task; None for regions and a uniform map. Raises InvalidInputError for a contradiction, TaskError."""
    regions = has_regions(options)
    if options.task is not None and regions:
        raise InvalidInputError("--task: give either a task, or regions with --roi, --objects or target-at, not both")
    if options.detector is not None and options.task is None:
        raise InvalidInputError("--detector: it finds the nouns of a task; give the task with --task TEXT")
    if options.task is not None:
        return DefaultParser().parse(options.task)
    if options.policy is not None and not regions and MissionSettings(policy=options.policy).follows_task:
        raise InvalidInputError(
            f"--policy {options.policy}: expected a task, with --task TEXT, or regions, with --roi FILE.npz or "
            "--set target-at=X,Y,Z[,R]"
        )
    return None


def has_regions(options: argparse.Namespace) -> bool:
    """Return True if the options select regions of space."""
    return bool(options.roi is not None or options.objects or options.target_at)


def run(options: argparse.Namespace) -> int:
    """Map the sequence and write the results. Errors in the options are raised before the work starts."""
    require_name("world-frame", options.world_frame or "")
    if options.view is not None:
        load_pages("--view").require_usable("--view")
    plan = plan_of(options)
    plan.check(options.out)
    if options.resume is None and not options.overwrite:
        require_absent(options.out / MAP)
    with locked_folder(options.out):
        if options.save_state is not None:
            require_additional_file(options.save_state, options.out)
        with _page(options.view) as begin_view:
            return _map(options, run := plan.open(), begin_view(run.scheduled))


def _map(options: argparse.Namespace, run: OpenRun, draw: Callable[[FrameOutcome], None]) -> int:
    # a signal while the results are written must not lose the rest of them
    with DeferredInterrupt() as interrupt:
        records = open_records()
        mapped = _map_frames(options, run, draw, records)
        written = _write_results(options, mapped, records) if mapped.is_worth_keeping else None
    # an early end keeps the map so far; the exit code reports it
    if isinstance(mapped.result.stopped_by, KeyboardInterrupt):
        raise type(mapped.result.stopped_by)(_interrupted_text(options, mapped.result, written))
    mapped.result.raise_if_stopped()
    if mapped.save_error is not None:
        raise mapped.save_error
    if interrupt.pending_exception is not None:
        raise type(interrupt.pending_exception)(f"all frames are mapped, and all files are in {options.out}")
    if written is not None:
        _print_results(options, mapped, written)
    if mapped.mapper.localisation is LocalisationState.LOST:
        return ROBOT_LOST
    return 0 if mapped.has_found_task else TASK_NOT_FOUND


def _map_frames(
    options: argparse.Namespace, run: OpenRun, draw: Callable[[FrameOutcome], None], records: Sequence[RunRecord]
) -> MappedRun:
    """Map all frames with a bar. Raises DatasetError if frames exist and none of them can be used."""
    mapper = run.scheduled.mapper
    with MappingBar(len(run.stream)) as bar:

        def report(outcome: FrameOutcome) -> None:
            bar.count(outcome)
            for record in records:
                record.add(outcome, mapper.poses, mapper.parts)
            draw(outcome)

        mapped = run.map(print_above_bar, report, options.strict, options.save_state)
    if mapped.result.processed == 0 and mapped.corrupt.first_error is not None:
        raise mapped.corrupt.first_error
    if mapper.count == 0 and mapped.result.processed > 0:
        require_mappable_depth(mapped)
    return mapped


@dataclass(frozen=True, slots=True)
class _Written:
    """What was written and is printed: report.json, its notes, what changed since the earlier map, and the scores."""

    report: Mapping[str, Any]
    notes: tuple[str, ...]
    changes: tuple[str, ...]
    scores: TrainingFit | None


def _write_results(options: argparse.Namespace, mapped: MappedRun, records: Sequence[RunRecord]) -> _Written:
    """Write map.ply, report.json, poses, keyframes, preview.png and the records of packages. Raises StorageError."""
    out, mapper, mission, prior = options.out, mapped.mapper, mapped.run.plan.mission, mapped.run.prior
    keyframes = mapper.keyframes()
    evaluator, missing = _evaluator()
    changes = compare_with_prior(prior, mapper.gaussians, mapper.objects, keyframes)
    notes = (*missing, *_notes(options, mapped))
    report: dict[str, object] = {
        **mapped.report(trajectory_report(mapped, evaluator)),
        "objects": [object_as_json(landmark) for landmark in changes.objects],
        "nouns": [noun_as_json(noun) for noun in mapper.nouns],
        "notes": list(notes),
        **changes.report,
    }
    prepare_folder(out)

    def render(frame: Frame) -> Rendering:
        seen = Gaussians.concatenate(list(mapper.parts(seen_by=frame)))
        return view_map(seen, mission.backend, mission.threads).render_frame(frame)

    views = [(keyframe.frame, keyframe.relevance.roi) for keyframe in keyframes]
    scores = evaluator.training_fit(render, views) if evaluator is not None and views else None
    if scores is not None:
        report["training_views"] = asdict(scores)
    stated = options.world_frame
    world_frame = default_world_frame(mapped.run.stream.source) if stated is None else str(stated)
    write_results(out, mapper.count, mapper.parts(), report, world_frame)
    write_poses(out, mapper.poses, None if prior is None else prior.motion)
    write_keyframes(out, keyframes)
    for record in records:
        record.write(out, keyframes)
    if evaluator is not None and views:
        write_png(out / PREVIEW, evaluator.preview(render, views))
    return _Written(report, notes, changes.lines, scores)


def _notes(options: argparse.Namespace, mapped: MappedRun) -> Iterator[str]:
    """Yield the messages on the recording, the task and the frames."""
    result = mapped.result
    yield from mapped.run.notes
    yield from mapped.mapper.notes
    if result.processed > 0 and not result.totals.region_seen:
        if options.task is not None:
            yield "found nothing of the task in these frames"
        elif has_regions(options):
            yield "none of these frames shows the selected region; check that it belongs to this sequence, in metres"
    for frame, _ in mapped.run.scheduled.schedule.switches:
        if frame > result.last_index:
            yield f"task-at {frame}: not reached, the last frame was {result.last_index}"
    median_m = _median_depth_m(mapped.mapper.keyframes())
    if median_m < _LEAST_DEPTH_M:
        yield f"the median depth is {median_m:.2g} m; {_depth_unit_advice(mapped.run.stream.source)}"


def _print_results(options: argparse.Namespace, mapped: MappedRun, written: _Written) -> None:
    """Print the figures and the notes of a complete run."""
    result, totals = mapped.result, mapped.result.totals
    counts = {words: totals.reasons[reason] for reason, words in _SKIPS.items()} | {"corrupt": mapped.corrupt.count}
    skipped = ", ".join(f"{count} {words}" for words, count in counts.items() if count)
    active = written.report["active_gaussians"]
    in_region = f" ({active:,} in the task's region)" if active or mapped.run.scheduled.schedule.graphs() else ""
    shown = "" if written.scores is None else f"; {PREVIEW} in the same folder shows it"
    print(
        f"{totals.frames} frames{f' (skipped: {skipped})' if skipped else ''} at {totals.hz:.1f} Hz, "
        f"{mapped.mapper.count:,} Gaussians{in_region} → {options.out / 'map.ply'}{shown}"
    )
    if totals.late:
        print(f"  {totals.late} of {totals.frames} frames missed the deadline of --rate {options.rate:g}")
    if options.poses is PoseMode.TRACK:
        print(f"  {tracking_text(written.report)}")
    if result.processed == 0:
        print(f"  no selected frame comes after frame {result.last_index}, the last one of the resumed run")
    # the notes repeat what is missing among the nouns
    for line in dict.fromkeys((*(noun.describe() for noun in mapped.mapper.nouns), *written.notes)):
        print(f"  {line}")
    for change in written.changes:
        print(f"  {change}")
    print(_outcome(mapped, written.scores))


def _outcome(mapped: MappedRun, scores: TrainingFit | None) -> str:
    """Return what was found, where, and how good the map is on views that it was trained on."""
    graph, region_m, mapper = mapped.run.scheduled.graph, mapped.region.means_m, mapped.mapper
    parts = [] if graph is None else [f"found: {found_text(mapper.objects, graph.targets, region_m, mapper.nouns)}"]
    if scores is not None:
        in_region = "" if scores.roi_psnr is None else f"{scores.roi_psnr:.1f} dB PSNR in the region, "
        views = f"{scores.n_views} training view{'s' if scores.n_views > 1 else ''}"
        parts.append(f"{views}: {in_region}{scores.full_psnr:.1f} dB in whole images")
    if mapped.mapper.localisation is LocalisationState.LOST:
        parts.append("the robot was lost at the end")
    return "; ".join(parts)


def _page(port: int | None) -> AbstractContextManager[BeginView]:
    """Return the page of a run; no page without a port."""
    if port is None:
        return nullcontext(lambda _mission: lambda _outcome: None)
    return load_pages("--view").mission_view(port)


def _interrupted_text(options: argparse.Namespace, result: MissionResult, written: _Written | None) -> str:
    """Return how many frames an interrupted run has mapped, where its files are, and how to resume it."""
    if written is None:
        return "no frame was mapped, and no file was written"
    files = "map.ply and report.json" if written.scores is None else f"map.ply, report.json and {PREVIEW}"
    text = f"{result.totals.frames} frames are mapped; {files} are in {options.out}"
    if options.save_state is None:
        return f"{text}; only a run with save-state can be resumed"
    return f"{text}; continue with --set resume={options.save_state}"


def _evaluator() -> tuple[Evaluator | None, tuple[str, ...]]:
    """Return what scores the run; None and a note without its package."""
    try:
        evaluator: Evaluator = load(Group.EVALUATORS, purpose=f"no scores and no {PREVIEW}")
    except MissingPluginError as error:
        return None, (str(error),)
    return evaluator, ()


def require_mappable_depth(mapped: MappedRun) -> None:
    """Raise DatasetError for frames that gave no Gaussian: without depth, or with depth too far away."""
    spec, source, result = mapped.run.plan.source.spec, mapped.run.stream.source, mapped.result
    if result.totals.frames == 0:
        reasons = ", ".join(f"in {count} {reason}" for reason, count in result.totals.reasons.items())
        advice = f"; {_depth_unit_advice(source)}" if TOO_FAR in result.totals.reasons else ""
        raise DatasetError(f"{spec}: expected frames with depth, got none in {result.processed}: {reasons}{advice}")
    if result.stopped_by is None:
        raise DatasetError(
            f"{spec}: expected surfaces in reach, got none in {result.processed} frames with a median depth of "
            f"{_median_depth_m(mapped.mapper.keyframes()):.3g} m; {_depth_unit_advice(source)}"
        )


def _depth_unit_advice(source: Source) -> str:
    return ", ".join(filter(None, ("check the depth unit", source.depth_unit_setting)))


def _median_depth_m(keyframes: Sequence[Keyframe]) -> float:
    medians = [
        float(np.median(keyframe.frame.depth_m[keyframe.frame.depth_m > 0]))
        for keyframe in keyframes
        if keyframe.frame.has_depth
    ]
    return float(np.median(medians)) if medians else np.inf
