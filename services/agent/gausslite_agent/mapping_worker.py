"""One robot's mapper on its own thread, behind a short queue of frames.

If frames arrive faster than they are mapped, the queue drops one: by default the OLDEST, because a live robot needs
the newest view. While no frame waits, the worker may train on earlier keyframes. Only the worker thread touches the
map, so the mapper needs no lock.
"""

from __future__ import annotations

import functools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from gausslite.domain.errors import InvalidInputError, MismatchError, RateLimitError, StorageError, UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectReport
from gausslite.domain.pose import PoseCorrection
from gausslite.domain.relevance import CameraView, PointedObject, PointM
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, empty_batch, group_by_voxel, replace_voxels
from gausslite.mapping.free_space import without_guesses
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.build import EstimatorBuilder, build_mapper, build_tracker, open_monitor
from gausslite.mission.checkpoint import ResumeConfig, save_run
from gausslite.mission.frame_scheduler import Clock, FrameScheduler
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.prior_map import PriorMap
from gausslite.mission.run_records import open_records
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.pointing import pointed_masks
from gausslite.wire.spool import Purpose
from gausslite.wire.uplink import Uplink
from gausslite_agent.keyframe_upload import KeyframeUpload
from gausslite_agent.settings import LoadSettings
from gausslite_agent.state import FrameReport, MissionCheckpoint, Outcome, SavedMission, StatusHolder, WorkerStatus

_Result = TypeVar("_Result")
_Arguments = ParamSpec("_Arguments")
_log = logging.getLogger(__name__)
_IDLE_WAIT_S = 10.0
_SHUTTING_DOWN = "agent: shutting down; it accepts no more work"
LOCALISING = "the agent localises itself in the map of --prior"


@dataclass(frozen=True, slots=True, eq=False)
class QueuedFrame:
    """A frame, the time of its arrival, and the future of its report."""

    frame: Frame
    arrival_s: float
    report: Future[FrameReport] = field(default_factory=Future)

    def __post_init__(self) -> None:
        # else its receiver could cancel it
        self.report.set_running_or_notify_cancel()


def _on_worker(
    method: Callable[Concatenate[MappingWorker, _Arguments], _Result],
) -> Callable[Concatenate[MappingWorker, _Arguments], Future[_Result]]:
    """Let the method run on the worker thread, between two frames; its caller gets a future."""

    @functools.wraps(method)
    def queue(self: MappingWorker, /, *arguments: _Arguments.args, **more: _Arguments.kwargs) -> Future[_Result]:
        return self._submit(lambda: method(self, *arguments, **more))

    return queue


def _before_frames(
    method: Callable[Concatenate[MappingWorker, _Arguments], _Result],
) -> Callable[Concatenate[MappingWorker, _Arguments], Future[_Result]]:
    """Let the method run on the worker thread before the frames that wait, because a person waits for it."""

    @functools.wraps(method)
    def queue(self: MappingWorker, /, *arguments: _Arguments.args, **more: _Arguments.kwargs) -> Future[_Result]:
        answer: Future[_Result] = Future()

        def call() -> None:
            try:
                answer.set_result(method(self, *arguments, **more))
            except Exception as error:
                answer.set_exception(error)

        self._calls.append((call, answer))
        self._submit(self._answer_calls)
        return answer

    return queue


class MappingWorker:
    """Owns the map and the worker thread."""

    def __init__(
        self,
        settings: MissionSettings,
        grid: VoxelGrid,
        build_estimator: EstimatorBuilder,
        uplink: Uplink | None = None,
        on_change: Callable[[], None] = lambda: None,
        load: LoadSettings | None = None,
        clock: Clock = time.monotonic,
        keyframe_upload: KeyframeUpload | None = None,
        prior: PriorMap | None = None,
    ) -> None:
        """build_estimator and on_change run on the worker thread, the latter after each mapped frame."""
        self._keyframe_upload = keyframe_upload
        self.prior = prior
        self._settings, self._build_estimator = settings, build_estimator
        self.grid, self.uplink = grid, uplink
        self._on_change = on_change
        self._load = load or LoadSettings()
        self._clock = clock
        self._mapper = build_mapper(settings, grid=grid)
        self._sent_voxels = SentVoxelTracker(grid)
        # updates that the spool refused
        self._unpublished = empty_batch()
        self._task_mapper: TaskMapper | None = None
        self._last_index = -1
        self.records = open_records()
        # returns the objects as people have corrected them; a service of `gausslite.agent_services` replaces it
        self.edit_objects: Callable[[Sequence[ObjectLandmark]], tuple[ObjectLandmark, ...]] = tuple
        # the start time, so that revisions from before a restart are never repeated
        self._first_revision = time.time_ns() // 1000
        self._status = StatusHolder(WorkerStatus(map_revision=self._first_revision))
        # guarded by the lock: frames arrive on several threads
        self._queue: deque[QueuedFrame] = deque()
        self._queue_lock = threading.Lock()
        # of people, in their order; each runs before the next frame
        self._calls: deque[tuple[Callable[[], None], Future[Any]]] = deque()
        self._worker = ThreadPoolExecutor(1, "mapper")
        # idle iterations that are left since the latest frame, whether one is queued, and whether some are unpublished
        self._idle_left, self._idle_scheduled, self._idle_unpublished = 0, False, False

    def status(self) -> WorkerStatus:
        """Return a snapshot of the totals."""
        return self._status.status

    def revision(self) -> int:
        """Return the map's revision. It increases, also across restarts."""
        return self.status().map_revision

    @_before_frames
    def assign(
        self, graph: TaskGraph | None, pointed: Sequence[PointedObject] = (), excluded_m: Sequence[PointM] = ()
    ) -> TaskGraph:
        """Switch to this task with the next frame, and return it; the map is kept and earlier keyframes re-evaluated.

        A task that is equivalent to the current one changes nothing; without one, the current task stays, with what a
        person points at. Raises InvalidInputError, ModelFileError and the like.
        """
        # before any change: a person may point at nothing
        masks = pointed_masks(pointed, ()) if self._task_mapper is None else self._task_mapper.pointed_masks(pointed)
        base = graph or self.status().graph or TaskGraph("", "", (), (), ())
        extended = base.with_pointed(noun for noun, _, _ in masks)
        task_mapper = self._switch(extended, is_extended=graph is None)
        task_mapper.point_at(masks, excluded_m)
        self._report_task(task_mapper)
        return extended

    @_before_frames
    def change_objects(self, change: Callable[[], bool]) -> None:
        """Run a person's change of the objects; if it returns True, the task means others, and its region follows."""
        if change() and self._task_mapper is not None:
            self._task_mapper.assign()
        if self._task_mapper is not None:
            self._report_task(self._task_mapper)

    @_on_worker
    def restore(self, saved: SavedMission) -> None:
        """Continue a saved mission; call it before the first frame. Raises MapFileError, StorageError."""
        checkpoint = saved.checkpoint
        task_mapper = self._switch(checkpoint.graph)
        saved.run.restore(task_mapper)
        # not before: the fusion server replaces what it has by each report
        self._report_task(task_mapper)
        self._last_index = checkpoint.last_index
        # the clock may have been set back since the mission was saved
        self._first_revision = max(self._first_revision, checkpoint.map_revision + 1)
        self._status.update(gaussians=self._mapper.count, map_revision=self._map_revision())
        # the spool drops what it has sent; the rest was in flight, or was published after the mission was saved
        # and the server may have voxels that the saved map does not
        self._publish(self._voxels_to_send(self._mapper.gaussians(active_only=True), Purpose.ROI))
        self._on_change()

    @_on_worker
    def save(self, path: Path, config: ResumeConfig, requested_task: str) -> float:
        """Save the mission after the current frame; returns the seconds that it took, 0 without a task.

        requested_task: the task of the command line. Raises StorageError.
        """
        graph, task_mapper = self.status().graph, self._task_mapper
        if graph is None or task_mapper is None:
            return 0.0
        start_s = time.monotonic()
        checkpoint = MissionCheckpoint(self._last_index, graph, requested_task, self.revision())
        extra = checkpoint.state() if self.prior is None else {**checkpoint.state(), **self.prior.state()}
        save_run(path, task_mapper, config, checkpoint.last_index, extra)
        return time.monotonic() - start_s

    @_on_worker
    def write_records(self, folder: Path, keyframes: Sequence[Keyframe]) -> None:
        """Write what packages have recorded since the program's start. Raises StorageError."""
        for record in self.records:
            record.write(folder, keyframes)

    @_before_frames
    def camera_view(self) -> CameraView | None:
        """Return what the camera sees, for a person; None before the first keyframe."""
        return None if self._task_mapper is None else self._task_mapper.camera_view()

    def submit(self, frame: Frame) -> Future[FrameReport]:
        """Queue a frame; return the future of its report. Raises MismatchError without a task, UnavailableError."""
        if self.status().graph is None:
            raise MismatchError("frames: expected a task first, got none yet; call AssignTask")
        queued = QueuedFrame(frame, self._clock())
        with self._queue_lock:
            self._queue.append(queued)
            dropped = self._queue.popleft() if len(self._queue) > self._load.queue_frames else None
        if dropped is not None:
            self._report_dropped(dropped, f"the queue of {self._load.queue_frames} frames dropped its oldest")
        self._submit(self._map_next)
        return queued.report

    def reject(self, index: int, reason: str) -> FrameReport:
        """Count and return the report of an invalid frame."""
        return self._count(FrameReport(index, Outcome.REJECTED, reason))

    def run(self, function: Callable[[GaussianMapper], _Result]) -> Future[_Result]:
        """Run a function of the mapper on the worker, between two frames."""
        return self._submit(lambda: function(self._mapper))

    def run_when_idle(self, function: Callable[[GaussianMapper], _Result]) -> _Result:
        """Return what a function of the mapper returns, run on the worker when no frame waits.

        Raises RateLimitError if frames leave no time for it within _IDLE_WAIT_S. Call it on a thread of your own.
        """
        end_s = time.monotonic() + _IDLE_WAIT_S
        while time.monotonic() < end_s:
            # of what waits, this then runs after the frames
            done = self._submit(lambda: None if self._queue else (function(self._mapper),)).result()
            if done is not None:
                return done[0]
        raise RateLimitError(
            f"views: expected time left after mapping, got none within {_IDLE_WAIT_S:g} s; call again later",
            retry_after_s=_IDLE_WAIT_S,
        )

    def end_idle_training(self) -> Future[None]:
        """End idle training until the next frame, and publish its changes."""
        return self._submit(self._end_idle_training)

    @_on_worker
    def insert_team_voxels(self, received: VoxelBatch) -> None:
        """Insert voxels that a teammate trained more than this agent."""
        if self._task_mapper is None:
            return
        inserted = self._task_mapper.insert_team_voxels(received, self.grid).gaussians
        if inserted:
            count = self.status().team_gaussians + inserted
            self._status.update(team_gaussians=count, gaussians=self._mapper.count, map_revision=self._map_revision())
            self._on_change()

    @_on_worker
    def handover_batch(self) -> VoxelBatch:
        """Return updates of the whole map, except guesses and voxels of an earlier task sent with a higher Σkappa.

        Guesses: see `without_guesses`. Voxels of an earlier handover that the map has lost get
        tombstones. Raises StorageError.
        """
        return self._voxels_to_send(
            without_guesses(self._mapper.gaussians(), (keyframe.frame for keyframe in self._mapper.store.kept))
        )

    @_on_worker
    def select_keyframes(self) -> None:
        """Select the keyframes to hand over from all that the mapper keeps, and pass them to the uplink."""
        if self._keyframe_upload is not None:
            self._keyframe_upload.enqueue_all(self._mapper.store.kept)

    def close(self) -> None:
        """End the worker after its current frame; waiting frames are dropped."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        while (queued := self._take()) is not None:
            self._report_dropped(queued, "the agent is shutting down")
        while self._calls:
            self._calls.popleft()[1].set_exception(UnavailableError(_SHUTTING_DOWN))

    def _submit(self, work: Callable[[], _Result]) -> Future[_Result]:
        try:
            return self._worker.submit(work)
        except RuntimeError as error:
            raise UnavailableError(_SHUTTING_DOWN) from error

    def _answer_calls(self) -> None:
        while self._calls:
            self._calls.popleft()[0]()

    def _take(self) -> QueuedFrame | None:
        with self._queue_lock:
            return self._queue.popleft() if self._queue else None

    def _switch(self, graph: TaskGraph, is_extended: bool = False) -> TaskMapper:
        """Make this the task of the next frame; return its mapper. is_extended: the same task with more targets."""
        current = self.status().graph
        if self._task_mapper is None:
            self._task_mapper = TaskMapper(
                self._build_estimator(graph),
                self._mapper,
                self._sent_voxels if self.uplink is not None else None,
                FrameScheduler(self._settings.scheduler_settings, self._clock),
                self._publish,
                tracker=build_tracker(self._settings, self._mapper),
                monitor=open_monitor(self._settings, self.prior, in_background=True, uplink=self.uplink),
            )
        elif current is None or graph.context != current.context or not graph.is_equivalent_to(current):
            change = self._task_mapper.extend if is_extended else self._task_mapper.assign
            change(self._build_estimator(graph))
        self._status.update(graph=graph)
        return self._task_mapper

    def _report_task(self, task_mapper: TaskMapper) -> None:
        self._update_notes(task_mapper.notes)
        self._update_objects(task_mapper.objects)
        for noun in task_mapper.nouns:
            _log.info("%s", noun.match.describe())

    def _voxels_to_send(self, gaussians: Gaussians, purpose: Purpose | None = None) -> VoxelBatch:
        """Return updates of these voxels, and tombstones of others sent for this purpose. Raises StorageError."""
        batch = self._sent_voxels.exclude_frozen(group_by_voxel(gaussians, self.grid))
        if self.uplink is None:
            return batch
        return self._sent_voxels.add_tombstones(batch, self.uplink.spool.voxels(purpose))

    def _map_next(self) -> None:
        self._answer_calls()
        queued = self._take()
        if queued is None:
            return
        try:
            queued.report.set_result(self._map(queued))
        except InvalidInputError as error:
            # later frames may be valid
            queued.report.set_result(self.reject(queued.frame.index, str(error)))
        except Exception as error:
            # the caller gets the error; the worker continues with the next frame
            queued.report.set_exception(error)
        self._idle_left = self._load.idle_iterations
        if not self._idle_scheduled and self._idle_left > 0:
            self._train_idle()

    def _map(self, queued: QueuedFrame) -> FrameReport:
        assert self._task_mapper is not None
        frame = self._place(queued.frame)
        if frame is None:
            self._set_localisation(LocalisationState.LOST)
            self._update_notes((LOCALISING,))
            return self._count(FrameReport(queued.frame.index, Outcome.SKIPPED, LOCALISING))
        outcome = self._task_mapper.process(frame, self._clock() - queued.arrival_s)
        self._last_index = frame.index
        self._set_localisation(self._task_mapper.localisation)
        for record in self.records:
            record.add(outcome, self._mapper.poses, self._mapper.parts)
        self._update_notes(self._task_mapper.notes)
        self._update_objects(self._task_mapper.objects)
        if outcome.skipped is not None:
            return self._count(FrameReport(frame.index, Outcome.SKIPPED, outcome.skipped, gaussians=outcome.gaussians))
        if outcome.changed_roi is not None:
            self._idle_unpublished = False
        report = FrameReport(
            frame.index,
            Outcome.MAPPED,
            iterations=outcome.iterations,
            gaussians=outcome.gaussians,
            roi_share=outcome.roi_share,
            seconds=outcome.timing.seconds,
            age_s=self._clock() - queued.arrival_s,
        )
        if self._keyframe_upload is not None:
            self._keyframe_upload.enqueue_newest(self._mapper.store.kept)
        self._status.update(correction=self._correction(), corrected_at_s=time.monotonic())
        self._count(report, outcome)
        self._on_change()
        return report

    def _set_localisation(self, localisation: LocalisationState) -> None:
        self._status.update(localisation=localisation)
        if self.uplink is not None:
            self.uplink.report_localisation(localisation.name.lower())

    def _place(self, frame: Frame) -> Frame | None:
        """Return the frame in the map's frame; None while the agent localises itself in an earlier map.

        The frame that localises it adds the earlier map. Raises QuotaError if that does not fit.
        """
        if self.prior is None:
            return frame
        was_done, graph = self.prior.is_done, self.status().graph
        placed = self.prior.place(frame)
        if not was_done and placed is not None:
            _log.warning("%s", self.prior.describe())
            earlier = self.prior.gaussians_for("" if graph is None else graph.text)
            if earlier is not None:
                self._mapper.continue_map(earlier)
        return placed

    def _correction(self) -> PoseCorrection | None:
        """Return the correction of the odometry's own poses."""
        latest, motion = self._mapper.poses.latest(), None if self.prior is None else self.prior.motion
        if latest is None or motion is None:
            return latest
        return replace(latest, T_map_odometry=latest.T_map_odometry @ motion)

    def _update_notes(self, notes: tuple[str, ...]) -> None:
        """Store the messages of the relevance estimator, and log each new one."""
        for note in set(notes) - set(self.status().notes):
            _log.warning("%s", note)
        self._status.update(notes=notes)

    def _update_objects(self, found: tuple[ObjectLandmark, ...]) -> None:
        """Store the confirmed objects, and report them with the task to the fusion server, as people corrected them."""
        assert self._task_mapper is not None
        objects = self.edit_objects(found)
        self._status.update(objects=objects, found=found, nouns=self._task_mapper.nouns)
        graph = self.status().graph
        if self.uplink is not None and graph is not None:
            self.uplink.report_objects(ObjectReport(graph, objects))

    def _train_idle(self) -> None:
        """Train one iteration if no frame waits, and schedule the next behind all queued work.

        An error is logged, because no caller waits for the result, and ends the iterations until the next frame.
        """
        self._idle_scheduled = not self._queue
        if not self._idle_scheduled:
            return
        try:
            if self._idle_left == 0 or self._task_mapper is None or not self._task_mapper.idle_step():
                self._end_idle_training()
                return
            self._status.update(idle_iterations=self.status().idle_iterations + 1)
            self._idle_left -= 1
            self._idle_unpublished = True
            # the executor accepts no work while the worker is closing
            with suppress(UnavailableError):
                self._submit(self._train_idle)
        except Exception:
            _log.exception("an idle iteration failed; idle training continues after the next frame")
            self._idle_left, self._idle_scheduled = 0, False

    def _end_idle_training(self) -> None:
        self._idle_left, self._idle_scheduled = 0, False
        if self._idle_unpublished and self._task_mapper is not None:
            self._idle_unpublished = False
            batch = self._task_mapper.changed_roi()
            if batch is not None:
                self._publish(batch)

    def _publish(self, batch: VoxelBatch) -> None:
        """Pass updates to the uplink. Those that its spool refuses are published again with the next frame."""
        if self.uplink is None:
            return
        publish_error = ""
        self._unpublished = replace_voxels(self._unpublished, batch)
        try:
            self.uplink.enqueue(self._unpublished)
            self._unpublished = empty_batch()
        except StorageError as error:
            publish_error = str(error)
        is_new = publish_error and not self.status().publish_error
        self._status.update(publish_error=publish_error)
        if is_new:
            _log.warning("%s", publish_error)

    def _report_dropped(self, queued: QueuedFrame, reason: str) -> None:
        queued.report.set_result(self._count(FrameReport(queued.frame.index, Outcome.DROPPED, reason)))

    def _count(self, report: FrameReport, outcome: FrameOutcome | None = None) -> FrameReport:
        self._status.count(report, self._map_revision(), outcome)
        return report

    def _map_revision(self) -> int:
        return self._first_revision + self._mapper.revision
