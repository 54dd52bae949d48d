"""`gausslite map`: map one sequence, for a task, for regions or uniformly."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path
from typing import Any

from gausslite.cli.map_inputs import FRAMES_KEY, MapInputs, has_regions, mission_settings, policy_of
from gausslite.cli.progress import MappingBar, print_above_bar
from gausslite.cli.source_options import (
    RecordingOptions,
    depth_notes,
    report_region_file,
    require_mappable_depth,
    selected_regions,
    stated_values,
)
from gausslite.codec.json import noun_as_json, object_as_json
from gausslite.codec.state_file import write_png
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite.datasets.open import open_reference
from gausslite.datasets.source import Source
from gausslite.domain.checks import require_name
from gausslite.domain.errors import DatasetError, InvalidInputError, MissingPluginError, PoseError, StorageError
from gausslite.domain.frame import NO_DEPTH, ONE_COLOUR
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import found_text
from gausslite.domain.relevance import Region
from gausslite.domain.state import State, encode_text, get_text
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.mapping.splat_table import SplatTable
from gausslite.mission.build import EstimatorFactory, build_task_mapper
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.evaluation import Evaluator, TrainingFit
from gausslite.mission.prior_map import PriorMap, open_prior_map, require_other_folder
from gausslite.mission.results import (
    MAP,
    PREVIEW,
    locked_folder,
    peak_rss_mib,
    prepare_folder,
    require_absent,
    require_additional_file,
    write_keyframes,
    write_poses,
    write_results,
)
from gausslite.mission.runner import CorruptFrames, MissionResult, MissionRunner
from gausslite.mission.schedule import MapRecorder, ScheduledTaskMapper, TaskSchedule, Timeline
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    PoseMode,
    SceneInfo,
    SourceSettings,
    TaskSettings,
)
from gausslite.mission.task_mapper import REPEATED, TRACKING_LOST, FrameOutcome, TaskMapper
from gausslite.pages import load_pages
from gausslite.plugins import Group, load
from gausslite.process import TASK_NOT_FOUND, DeferredInterrupt, print_message
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import view_map
from gausslite.wire.channel import MAX_PORT


def trajectory_report(
    settings: SourceSettings, source: Source, mapper: TaskMapper, evaluator: Evaluator | None
) -> dict[str, object]:
    """Return the ATE of the map's trajectory and of the given one, if true poses exist, and the tracking counts.

    source: the sequence as it was mapped. evaluator: None leaves out the ATE.
    """
    errors: dict[str, object] = {"ate": None, "given_ate": None, "tracking": dict(mapper.tracking_counts)}
    try:
        reference = open_reference(settings.spec, settings.depth_registration)
        true = None if reference is None else reference.trajectory()
        given = source.trajectory()
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


_SKIPS = {
    NO_DEPTH: "without depth",
    ONE_COLOUR: "of one colour",
    REPEATED: "repeated",
    TRACKING_LOST: "lost by tracking",
}
_NOT_RESUMED = -1
_POINTED = "pointed"
"""Name of the nouns that a person points at, among the extra arrays of a saved run."""


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
    force: bool = option(
        False, "map although poses or depth contradict the images (default: end with what would agree)"
    )
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


def run(options: argparse.Namespace) -> int:
    """Map the sequence and write the results. Errors in the options are raised before the work starts."""
    require_name("world-frame", options.world_frame or "")
    if options.view is not None:
        load_pages("--view").require_usable("--view")
    if options.prior is not None and options.resume is not None:
        raise InvalidInputError("--prior: expected it without resume; a saved run knows the map that it continues")
    require_other_folder(options.prior, options.out)
    if options.resume is None and not options.overwrite:
        require_absent(options.out / MAP)
    with locked_folder(options.out):
        return _map(options)


def _map(options: argparse.Namespace) -> int:
    saved = None if options.resume is None else SavedRun.read(options.resume)
    prior = open_prior_map(options.prior, {} if saved is None else saved.extra, mission_settings(options))
    inputs = MapInputs.of(options)
    if saved is not None:
        inputs = inputs.resumed(options, saved)
    if options.save_state is not None:
        require_additional_file(options.save_state, options.out)
    resumed_after = _NOT_RESUMED if saved is None else saved.last_index
    # a person can point on the page
    needs_detector = options.view is None
    estimators = EstimatorFactory(inputs.perception, lambda: SceneInfo.of(inputs.stream.source), needs_detector)
    roi = _first_roi(options, inputs, saved)
    if saved is None:
        # an estimate takes half a minute; first refuse what cannot be mapped, and name what cannot be found
        choose_rasterizer(inputs.mission.backend, inputs.mission.threads)
        SplatTable(inputs.mission.max_gaussians)
        if isinstance(roi, TaskGraph):
            estimators.require_detector()
    _report_search(options, inputs, estimators)
    if saved is None:
        stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
        inputs = inputs.calibrated(replace(stated, force=options.force))
    if options.prior is not None:
        # without given poses, frames far apart in time are in no common frame
        prior.localise(inputs.stream, spread=inputs.mission.poses is not PoseMode.TRACK)
        print_message(prior.describe())
    if prior.motion is not None:
        inputs = inputs.in_frame_of(prior)
        estimators = estimators.in_scene(lambda: SceneInfo.of(inputs.stream.source))
        roi = _first_roi(options, inputs, saved)
    task = "" if inputs.schedule.first is None else inputs.schedule.first.text
    mapper = build_task_mapper(inputs.mission, estimators, roi, prior.gaussians_for(task))
    if saved is not None:
        saved.restore(mapper)
        saved = None  # its arrays, as large as the map and the keyframes, have been copied
    graph = roi if isinstance(roi, TaskGraph) else None
    scheduled = ScheduledTaskMapper(mapper, inputs.schedule, estimators, graph, resumed_after)
    mapping = _Run(options, inputs, scheduled, prior)
    # a signal while the results are written must not lose the rest of them
    with DeferredInterrupt() as interrupt:
        result = mapping.map_frames(resumed_after)
        if result.processed > 0 or result.stopped_by is None:
            mapping.write_results(result)
    # an early end keeps the map so far; the exit code reports it
    mapping.raise_if_failed(result)
    if interrupt.pending_exception is not None:
        raise type(interrupt.pending_exception)(f"all frames are mapped, and all files are in {options.out}")
    mapping.print_results(result)
    return 0 if mapping.has_found_task(result) else TASK_NOT_FOUND


class _Run:
    """One run: its frame loop and its results."""

    def __init__(
        self, options: argparse.Namespace, inputs: MapInputs, scheduled: ScheduledTaskMapper, prior: PriorMap
    ) -> None:
        self._options, self._inputs, self._prior = options, inputs, prior
        self._changes: tuple[str, ...] = ()
        self._scheduled, self._mapper = scheduled, scheduled.mapper
        self._corrupt = CorruptFrames(print_above_bar)
        self._timeline, self._recorder = Timeline(), MapRecorder()
        self._gaussians = Gaussians.empty()
        self._report: dict[str, object] = {}
        self._notes: tuple[str, ...] = ()
        self._training_scores: TrainingFit | None = None
        self._save_error: StorageError | None = None

    def map_frames(self, resumed_after: int) -> MissionResult:
        """Map the frames after an index. Raises DatasetError if frames exist and none of them can be used."""
        inputs, options = self._inputs, self._options
        stream = inputs.stream.after(resumed_after)
        frames = stream.frames(None if options.strict else self._corrupt)
        with _view(options.view, self._scheduled) as draw, MappingBar(len(stream)) as bar:

            def report(outcome: FrameOutcome) -> None:
                bar.count(outcome)
                self._timeline.add(outcome)
                self._recorder.record(self._mapper.poses, self._mapper.gaussians)
                draw(outcome)

            checkpoint = None if options.save_state is None else self._save
            result = MissionRunner(self._scheduled.process, report, checkpoint).run(frames, resumed_after)
        # a person may have given other tasks on the page
        self._inputs = replace(inputs, schedule=self._scheduled.schedule)
        if result.processed == 0 and self._corrupt.first_error is not None:
            raise self._corrupt.first_error
        self._gaussians = self._mapper.gaussians()
        if len(self._gaussians) == 0 and result.processed > 0:
            require_mappable_depth(options.source, inputs.stream.source, result, self._mapper.keyframes())
        return result

    def write_results(self, result: MissionResult) -> None:
        """Write map.ply, report.json, frames.csv, history, poses, keyframes and preview.png. Raises StorageError."""
        options, mission, graph = self._options, self._inputs.mission, self._scheduled.graph
        evaluator, missing = _evaluator()
        self._notes = (
            *missing,
            *self._inputs.notes,
            *self._mapper.notes,
            *_unseen_notes(options, result),
            *_unreached_notes(self._inputs.schedule, result.last_index),
            *depth_notes(self._inputs.stream.source, self._mapper.keyframes()),
        )
        changes = self._prior.compare(self._gaussians, self._mapper.objects, self._mapper.keyframes())
        self._changes = changes.lines
        self._report = {
            **self._inputs.report(),
            "resumed_from": None if options.resume is None else str(options.resume),
            **result.summary(),
            **trajectory_report(self._inputs.source, self._inputs.stream.source, self._mapper, evaluator),
            "targets": [] if graph is None else list(graph.targets),
            "loops": asdict(self._mapper.loops),
            "frames_corrupt": self._corrupt.count,
            "gaussians": len(self._gaussians),
            "active_gaussians": int(self._gaussians.active.sum()),
            "peak_rss_mib": peak_rss_mib(),
            "memory_mib": self._mapper.memory_mib(),
            "objects": [object_as_json(landmark) for landmark in changes.objects],
            "nouns": [noun_as_json(noun) for noun in self._mapper.nouns],
            "notes": list(self._notes),
            **changes.report,
        }
        prepare_folder(options.out)
        keyframes = [(keyframe.frame, keyframe.relevance.roi) for keyframe in self._mapper.keyframes()]
        viewer = view_map(self._gaussians, mission.backend, mission.threads)
        if evaluator is not None and keyframes:
            self._training_scores = evaluator.training_fit(viewer, keyframes)
            self._report["training_views"] = asdict(self._training_scores)
        write_results(options.out, self._gaussians, self._report, self._inputs.world_frame(options))
        write_poses(options.out, self._mapper.poses, self._prior.motion)
        self._timeline.write(options.out)
        self._recorder.write(options.out)
        write_keyframes(options.out, self._mapper.keyframes())
        if evaluator is not None and keyframes:
            write_png(options.out / PREVIEW, evaluator.preview(viewer, keyframes))

    def raise_if_failed(self, result: MissionResult) -> None:
        """Raise the error that ended the run early, the interrupt with a text on what is kept, or that of saving."""
        if isinstance(result.stopped_by, KeyboardInterrupt):
            raise type(result.stopped_by)(_interrupted_text(self._options, result, self._training_scores is not None))
        result.raise_if_stopped()
        if self._save_error is not None:
            raise self._save_error

    def has_found_task(self, result: MissionResult) -> bool:
        """Return False if a task was mapped, and no frame and no object of the map shows a target of it."""
        graphs = self._inputs.schedule.graphs()
        targets = {noun_of(target) for graph in graphs for target in graph.targets}
        is_in_map = any(landmark.noun in targets for landmark in self._mapper.objects)
        return not graphs or result.processed == 0 or result.totals.region_seen or is_in_map

    def print_results(self, result: MissionResult) -> None:
        """Print the figures and the notes of a complete run."""
        totals, report = result.totals, self._report
        counts = {words: totals.reasons[reason] for reason, words in _SKIPS.items()} | {"corrupt": self._corrupt.count}
        skipped = ", ".join(f"{count} {words}" for words, count in counts.items() if count)
        active = report["active_gaussians"]
        in_region = f" ({active:,} in the task's region)" if active or self._inputs.schedule.graphs() else ""
        shown = "" if self._training_scores is None else f"; {PREVIEW} in the same folder shows it"
        print(
            f"{totals.frames} frames{f' (skipped: {skipped})' if skipped else ''} at {result.hz:.1f} Hz, "
            f"{len(self._gaussians):,} Gaussians{in_region} → {self._options.out / 'map.ply'}{shown}"
        )
        if totals.late:
            print(f"  {totals.late} of {totals.frames} frames missed the deadline of --rate {self._options.rate:g}")
        if self._inputs.mission.poses is PoseMode.TRACK:
            print(f"  {tracking_text(report)}")
        if result.processed == 0:
            print(f"  no selected frame comes after frame {result.last_index}, the last one of the resumed run")
        # the notes repeat what is missing among the nouns
        for line in dict.fromkeys((*(noun.describe() for noun in self._mapper.nouns), *self._notes)):
            print(f"  {line}")
        for change in self._changes:
            print(f"  {change}")
        print(self._outcome())

    def _outcome(self) -> str:
        """Return what was found, where, and how good the map is on views that it was trained on."""
        graph, gaussians = self._scheduled.graph, self._gaussians
        region_m = gaussians.means_m[gaussians.active]
        parts = [] if graph is None else [f"found: {found_text(self._mapper.objects, graph.targets, region_m)}"]
        if self._training_scores is not None:
            scores = self._training_scores
            in_region = "" if scores.roi_psnr is None else f"{scores.roi_psnr:.1f} dB PSNR in the region, "
            views = f"{scores.n_views} training view{'s' if scores.n_views > 1 else ''}"
            parts.append(f"{views}: {in_region}{scores.full_psnr:.1f} dB in whole images")
        return "; ".join(parts)

    def _save(self, last_index: int) -> None:
        prepare_folder(self._options.save_state.parent)
        extra: State = {FRAMES_KEY: encode_text(self._options.frames), **self._prior.state()}
        if self._scheduled.graph is not None and self._scheduled.graph.pointed:
            extra = {**extra, _POINTED: encode_text("\n".join(self._scheduled.graph.pointed))}
        fixed = replace(self._inputs, schedule=self._scheduled.schedule).fixed_settings(last_index)
        try:
            save_run(self._options.save_state, self._mapper, ResumeConfig.of(*fixed), last_index, extra)
        except StorageError as error:
            self._save_error = error  # the map is worth writing nevertheless


def _first_roi(options: argparse.Namespace, inputs: MapInputs, saved: SavedRun | None) -> TaskGraph | list[Region]:
    """Return the first frame's task, with what a person has pointed at in the saved run, or the regions."""
    graph = inputs.schedule.at(_NOT_RESUMED if saved is None else saved.last_index)
    if graph is None:
        return selected_regions(options, inputs.stream.source)
    if saved is None or _POINTED not in saved.extra:
        return graph
    return graph.with_pointed(get_text(saved.extra, _POINTED).split("\n"))


def _report_search(options: argparse.Namespace, inputs: MapInputs, estimators: EstimatorFactory) -> None:
    """Report what is searched for each noun of the tasks."""
    if options.detector is None and inputs.schedule.graphs():
        report_region_file(options.source, inputs.stream.source)
    for scheduled in inputs.schedule.graphs():
        for match in estimators.noun_matches(scheduled):
            print_message(match.describe())


def _view(port: int | None, mission: ScheduledTaskMapper) -> AbstractContextManager[Callable[[FrameOutcome], None]]:
    """Return the page of a run, whose context gives what to call after each frame; no page without a port."""
    if port is None:
        return nullcontext(lambda _outcome: None)
    return load_pages("--view").mission_view(port, mission)


def _interrupted_text(options: argparse.Namespace, result: MissionResult, has_preview: bool) -> str:
    """Return how many frames an interrupted run has mapped, where its files are, and how to resume it."""
    if result.processed == 0:
        return "no frame was mapped, and no file was written"
    files = f"map.ply, report.json and {PREVIEW}" if has_preview else "map.ply and report.json"
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


def _unseen_notes(options: argparse.Namespace, result: MissionResult) -> tuple[str, ...]:
    """Return a note if no frame showed the task's objects or the selected regions."""
    if result.totals.region_seen or result.processed == 0:
        return ()
    if options.task is not None:
        return ("none of these frames shows an object of the task",)
    if has_regions(options):
        return ("none of these frames shows the selected region; check that it belongs to this sequence, in metres",)
    return ()


def _unreached_notes(schedule: TaskSchedule, last_index: int) -> tuple[str, ...]:
    """Return a note for each scheduled task after the last frame."""
    return tuple(
        f"task-at {frame}: not reached, the last frame was {last_index}"
        for frame, _ in schedule.switches
        if frame > last_index
    )
