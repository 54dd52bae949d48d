"""The front half of every run: `RunPlan`, of options or arguments; `open` it to an `OpenRun`; `map` that to a result.

Each step returns a new value and changes none. Checks come first, estimates of half a minute and models after them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from gausslite.codec.json import graph_as_json
from gausslite.config.option import option
from gausslite.datasets.calibration import Calibration, StatedValues
from gausslite.datasets.source import Source, frame_step, numbering_note
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.domain.relevance import Region
from gausslite.domain.state import State, encode_text, get_text
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.mapping.splat_table import require_memory
from gausslite.mission.build import EstimatorFactory, build_task_mapper, open_monitor
from gausslite.mission.checkpoint import ResumeConfig, SavedRun, save_run
from gausslite.mission.prior_map import PriorMap, open_prior_map
from gausslite.mission.recording import calibrate_with_messages, open_for_mapping, selected_regions
from gausslite.mission.results import peak_rss_mib, prepare_folder
from gausslite.mission.runner import CorruptFrames, FrameStream, MissionResult, MissionRunner, ground_truth_notes
from gausslite.mission.schedule import ScheduledTaskMapper, TaskSchedule
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    PoseMode,
    SceneInfo,
    SourceSettings,
    TaskSettings,
)
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.process import print_message
from gausslite.render.choose import choose_rasterizer

_NOT_RESUMED = -1
_FRAMES, _POINTED = "frames", "pointed"
"""Names of two texts among the extra arrays of a saved run: --frames, and the nouns that a person points at."""


@dataclass(frozen=True, slots=True)
class _Sequence:
    """The sequence of a saved run: a folder may move, but it must keep its name."""

    name: str = option(MISSING, "name of the sequence", key="SOURCE")


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a run maps, and how. Without tasks and regions, the map is uniform.

    In mission and source, what is still to be estimated counts as exact and as recorded.
    """

    mission: MissionSettings
    perception: PerceptionSettings
    source: SourceSettings = field(default_factory=lambda: SourceSettings(""))
    schedule: TaskSchedule = field(default_factory=lambda: TaskSchedule(None))
    task: TaskSettings = field(default_factory=TaskSettings)  # selects regions of the sequence
    regions: tuple[Region, ...] = ()  # given regions, in place of a task's
    stated: StatedValues = field(default_factory=StatedValues)  # what the user states of the recording
    can_point: bool = False  # a person can point at what nothing detects
    prior: Path | None = None  # the folder of the run whose map is continued
    resume: Path | None = None  # a saved run
    notes: tuple[str, ...] = ()  # for the user

    def check(self, out: Path | None) -> None:
        """Raise for what would fail later, before anything is opened. out: the folder of the results.

        Raises InvalidInputError, KernelError, MissingPluginError.
        """
        if self.prior is not None and self.resume is not None:
            raise InvalidInputError("--prior: expected it without resume; a saved run knows the map that it continues")
        if self.prior is not None and out is not None and self.prior.resolve() == out.resolve():
            raise InvalidInputError(f"--prior {self.prior}: expected another folder than --out, whose map is replaced")
        choose_rasterizer(self.mission.backend, self.mission.threads)
        require_memory(self.mission.max_gaussians)

    def open(self) -> OpenRun:
        """Open the recording, the earlier map and the models, with messages on stderr.

        Raises DatasetError, PoseError, InvalidInputError, MapFileError, ModelFileError, MissingPluginError;
        MismatchError if the options differ from those of the saved run.
        """
        saved = None if self.resume is None else SavedRun.read(self.resume)
        prior = open_prior_map(self.prior, {} if saved is None else saved.extra, self.mission)
        recorded = FrameStream.select(open_for_mapping(self.source), self.source)
        for note in filter(None, (*self.notes, numbering_note(recorded.source, self.source.frames))):
            print_message(note)
        stated = self._stated(recorded.source, saved)
        if saved is not None:
            self._with_values(recorded, stated).require_same(saved, recorded.source.world_frame)
        models = EstimatorFactory(self.perception, lambda: SceneInfo.of(recorded.source), not self.can_point)
        roi = self._first_roi(recorded.source, saved)
        # an estimate takes half a minute; first refuse what cannot be mapped, and name what cannot be found
        if saved is None and isinstance(roi, TaskGraph):
            models.require_detector()
        self._report_search(recorded.source, models)
        # models and regions again below if the earlier map moves the sequence: they were found in the recording's frame
        found = calibrate_with_messages(self.source.spec, recorded.source, stated)
        stream = self._localised(replace(recorded, source=found.source), prior)
        plan, is_moved = self._with_values(recorded, found), prior is not None and prior.motion is not None
        mapper = plan._mapper(
            models.in_scene(lambda: SceneInfo.of(stream.source)) if is_moved else models,
            self._first_roi(stream.source, saved) if is_moved else roi,
            saved,
            prior,
        )
        return OpenRun(plan, stream.after(mapper.last_index), mapper, recorded.source.world_frame, prior, found.notes)

    def open_source(self, source: Source) -> OpenRun:
        """Open the run on a sequence that is mapped as it is. Raises DatasetError, and the errors of `task_mapper`."""
        models = EstimatorFactory(self.perception, lambda: SceneInfo.of(source))
        mapper = self._mapper(models, self.schedule.first or self.regions)
        return OpenRun(self, FrameStream.select(source, self.source), mapper, source.world_frame)

    def task_mapper(self, scene: SceneInfo) -> TaskMapper:
        """Return a mapper for other frames. Raises InvalidInputError, ModelFileError, KernelError."""
        models = EstimatorFactory(self.perception, lambda: scene)
        roi, monitor = self.schedule.first or self.regions, open_monitor(self.mission, in_background=False)
        return build_task_mapper(self.mission, models, roi, monitor=monitor)

    def _stated(self, source: Source, saved: SavedRun | None) -> StatedValues:
        """Return what is not to be estimated: also what a saved run has, and what needs poses that are not used."""
        stated, poses = self.stated, self.mission.poses
        if saved is not None:
            registration = stated.registration
            if registration is None and not stated.depth_as_recorded:
                registration = saved.value(SourceSettings, "depth_registration")
            correction = stated.correction or saved.value(SourceSettings, "camera_correction") or CameraCorrection()
            pose_prior = stated.pose_prior or saved.value(MissionSettings, "pose_prior")
            return StatedValues.all_of(registration, correction, pose_prior)
        correction, pose_prior = stated.correction, stated.pose_prior
        if poses is PoseMode.TRACK:
            # readout time and offset need given poses: only the lens is kept
            correction = correction or CameraCorrection(source.lens)
        if poses is not PoseMode.REFINE:
            pose_prior = pose_prior or PoseExposurePrior()
        return replace(stated, correction=correction, pose_prior=pose_prior, checked=poses is PoseMode.TRACK)

    def _with_values(self, recorded: FrameStream, found: StatedValues | Calibration) -> RunPlan:
        """Return the plan with the size of the images and these values of the recording."""
        mission = replace(self.mission, pose_prior=found.pose_prior or PoseExposurePrior())
        source = replace(
            self.source,
            size=f"{recorded.size[0]}x{recorded.size[1]}",
            depth_registration=found.registration,
            camera_correction=None if found.correction is None or found.correction.is_identity else found.correction,
        )
        return replace(self, mission=replace(mission, pose_prior=mission.refinement_prior), source=source)

    def fixed_settings(self, graph: TaskGraph | None, sequence: str) -> tuple[Any, ...]:
        """Return the settings that a run must have to continue after a frame with this task."""
        task = replace(self.task, task=None if graph is None else graph.text)
        return self.mission, self.perception, self.source, task, _Sequence(sequence)

    def require_same(self, saved: SavedRun, sequence: str) -> None:
        """Raise MismatchError if settings differ from the saved run's; report another step of its frames."""
        saved.require(*self.fixed_settings(self.schedule.at(saved.last_index), sequence))
        if _FRAMES not in saved.extra:
            return
        before, now = frame_step(get_text(saved.extra, _FRAMES)), frame_step(self.source.frames)
        if before != now:
            print_message(f"--frames: the saved run has a step of {before} frames, this one of {now}")

    def _first_roi(self, source: Source, saved: SavedRun | None) -> TaskGraph | list[Region]:
        """Return the first frame's task, with what a person has pointed at in the saved run, or the regions."""
        graph = self.schedule.at(_NOT_RESUMED if saved is None else saved.last_index)
        if graph is None:
            return selected_regions(self.source.spec, source, self.task.roi, self.task.objects, self.task.target_at)
        if saved is None or _POINTED not in saved.extra:
            return graph
        return graph.with_pointed(get_text(saved.extra, _POINTED).split("\n"))

    def _report_search(self, source: Source, models: EstimatorFactory) -> None:
        """Report what of the tasks is not understood, and what is searched for each noun."""
        graphs = self.schedule.graphs()
        if graphs and self.perception.model is None:
            for note in ground_truth_notes(self.source.spec, source):
                print_message(note)
        for graph in graphs:
            for line in (*graph.warnings, *(match.describe() for match in models.noun_matches(graph))):
                print_message(line)

    def _localised(self, stream: FrameStream, prior: PriorMap | None) -> FrameStream:
        """Return the sequence in the world frame of the earlier map, if it is recognised there."""
        if prior is None:
            return stream
        if self.prior is not None:
            # without given poses, frames far apart in time are in no common frame
            prior.localise(stream, spread=self.mission.poses is not PoseMode.TRACK)
            print_message(prior.describe())
        return stream if prior.motion is None else replace(stream, source=prior.moved(stream.source))

    def _mapper(
        self,
        models: EstimatorFactory,
        roi: TaskGraph | Sequence[Region],
        saved: SavedRun | None = None,
        prior: PriorMap | None = None,
    ) -> ScheduledTaskMapper:
        """Return the mapper before its first frame, or as the saved run left it."""
        task = "" if self.schedule.first is None else self.schedule.first.text
        earlier, monitor = None if prior is None else prior.gaussians_for(task), open_monitor(self.mission, prior)
        mapper = build_task_mapper(self.mission, models, roi, earlier, monitor)
        if saved is not None:
            saved.restore(mapper)
        last_index = _NOT_RESUMED if saved is None else saved.last_index
        return ScheduledTaskMapper(
            mapper, self.schedule, models, roi if isinstance(roi, TaskGraph) else None, last_index
        )


@dataclass(frozen=True, slots=True, eq=False)
class OpenRun:
    """A run before its first frame: its frames, and the mapper that owns the map."""

    plan: RunPlan  # with the values that were found
    stream: FrameStream
    scheduled: ScheduledTaskMapper
    sequence: str  # world frame of the recording; that of the stream is the map's
    prior: PriorMap | None = None  # the earlier map that is continued
    notes: tuple[str, ...] = ()  # on poses or depth that contradict the images

    def map(
        self,
        report: Callable[[str], None],
        on_frame: Callable[[FrameOutcome], None] = lambda _outcome: None,
        strict: bool = False,
        save_state: Path | None = None,
    ) -> MappedRun:
        """Map all frames, until an error or Ctrl-C; save the run at its end.

        report: gets a line for each frame that cannot be read and is skipped; with `strict` the run ends there.
        """
        corrupt = CorruptFrames(report)
        frames = self.stream.frames(None if strict else corrupt)
        result = MissionRunner(self.scheduled.process, on_frame).run(frames, self.scheduled.last_index)
        mapped = MappedRun(self, result, corrupt, self.scheduled.mapper.gaussians(active_only=True))
        if save_state is None or not mapped.is_worth_keeping:
            return mapped
        try:
            self._save(save_state, result.last_index)
        except StorageError as error:
            return replace(mapped, save_error=error)  # the map is worth writing nevertheless
        return mapped

    def report(self) -> dict[str, object]:
        """Return the settings and the tasks as part of report.json."""
        schedule, mission, source = self.scheduled.schedule, self.plan.mission, self.plan.source
        registration, correction = source.depth_registration, source.camera_correction
        first, prior = schedule.first, mission.pose_prior
        return {
            "source": source.spec,
            "up": list(self.stream.source.up_axis),
            "colour_camera": None if registration is None else str(registration),
            "camera_correction": None if correction is None else str(correction),
            "view_error": None if prior.is_exact else str(prior),
            "task": None if first is None else {"text": first.text, **graph_as_json(first)},
            "then": [
                {"frame": frame, "text": graph.text, **graph_as_json(graph)} for frame, graph in schedule.switches
            ],
            "poses": str(mission.poses),
            "policy": mission.policy,
            "without": sorted(mission.disabled),
            "size": list(self.stream.size),
            "seed": mission.seed,
            "max_gaussians": mission.max_gaussians,
            "hold_out": source.test_every,
            "selected_frames": source.frames,
        }

    def _save(self, path: Path, last_index: int) -> None:
        prepare_folder(path.parent)
        graph = self.scheduled.graph
        extra: State = {_FRAMES: encode_text(self.plan.source.frames)}
        if self.prior is not None:
            extra = {**extra, **self.prior.state()}
        if graph is not None and graph.pointed:
            extra = {**extra, _POINTED: encode_text("\n".join(graph.pointed))}
        config = ResumeConfig.of(*self.plan.fixed_settings(self.scheduled.schedule.at(last_index), self.sequence))
        save_run(path, self.scheduled.mapper, config, last_index, extra)


@dataclass(frozen=True, slots=True, eq=False)
class MappedRun:
    """A run after its last frame."""

    run: OpenRun
    result: MissionResult
    corrupt: CorruptFrames  # frames that could not be read
    region: Gaussians  # those of the task
    save_error: StorageError | None = None  # why it could not be saved

    @property
    def mapper(self) -> TaskMapper:
        """The mapper of the run."""
        return self.run.scheduled.mapper

    @property
    def is_worth_keeping(self) -> bool:
        """False if an error came before the first frame."""
        return self.result.processed > 0 or self.result.stopped_by is None

    def report(self, trajectory: Mapping[str, object]) -> dict[str, object]:
        """Return the settings, the tasks and the figures of frames, trajectory and map as part of report.json."""
        graph, resume = self.run.scheduled.graph, self.run.plan.resume
        return {
            **self.run.report(),
            "resumed_from": None if resume is None else str(resume),
            **self.result.summary(),
            **trajectory,
            "targets": [] if graph is None else list(graph.targets),
            "loops": asdict(self.mapper.loops),
            "localisation": self.mapper.localisation.name.lower(),
            "frames_corrupt": self.corrupt.count,
            "gaussians": self.mapper.count,
            "active_gaussians": len(self.region),
            "peak_rss_mib": peak_rss_mib(),
            "memory_mib": self.mapper.memory_mib(),
        }

    @property
    def has_found_task(self) -> bool:
        """False if a task was mapped, and no frame and no object of the map shows a target of it."""
        graphs = self.run.scheduled.schedule.graphs()
        targets = {noun_of(target) for graph in graphs for target in graph.targets}
        is_in_map = any(landmark.noun in targets for landmark in self.mapper.objects)
        return not graphs or self.result.processed == 0 or self.result.totals.region_seen or is_in_map
