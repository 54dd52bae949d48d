"""One robot's mapper on one worker thread, with a short queue of frames before it.

When frames come faster than they are mapped one is dropped and says so: by default the OLDEST that waits, since a live
robot wants the newest view. While none comes the worker may train on what it has seen, one iteration at a time.
Everything that touches the map runs on the worker, so the mapper needs no lock.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from gausslite.domain.frame import Frame
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError, MismatchError, StorageError, UnavailableError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.sent_voxels import SentVoxelTracker
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.build import build_mapper
from gausslite.mission.checkpoint import ResumeConfig, save_run
from gausslite.mission.frame_scheduler import Clock, FrameScheduler
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance_estimator import RelevanceEstimator
from gausslite.wire.uplink import Uplink
from gausslite_agent.load import Drops, LoadSettings
from gausslite_agent.mission_checkpoint import MissionCheckpoint, SavedAgentMission
from gausslite_agent.status import FrameReport, Outcome, WorkerStatus

_log = logging.getLogger(__name__)
_Result = TypeVar("_Result")


def _promise() -> Future[FrameReport]:
    """A report to come, whether or not the one who waits for it gives up."""
    future: Future[FrameReport] = Future()
    future.set_running_or_notify_cancel()
    return future


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    """A frame in the queue, since when it waits, and its report to come."""

    frame: Frame
    since_s: float
    future: Future[FrameReport] = field(default_factory=_promise)


class MappingWorker:
    """Owns the map and the worker thread. `attention` makes what attends to a task; it runs on the worker."""

    def __init__(
        self,
        settings: MissionSettings,
        grid: VoxelGrid,
        attention: Callable[[TaskGraph], RelevanceEstimator],
        uplink: Uplink | None = None,
        on_change: Callable[[], None] = lambda: None,
        load: LoadSettings | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """Reserve the map's memory. on_change is called on the worker after each mapped frame."""
        self._settings, self._grid, self._make_attention = settings, grid, attention
        self.uplink = uplink
        self._on_change = on_change
        self._load = load or LoadSettings()
        self._clock = clock
        # how many iterations may still be rehearsed, and whether words are due for those that were; worker only
        self._rehearsals_left, self._resting, self._untold = 0, False, False
        self._mapper = build_mapper(settings)
        self._ledger = SentVoxelTracker(grid)
        self._task_mapper: TaskMapper | None = None
        self._last_index = -1
        # revisions of an earlier life must not be taken for ones of this
        self._first_revision = time.time_ns() // 1000
        self._status = WorkerStatus(map_revision=self._first_revision)
        self._waiting: deque[_Waiting] = deque()
        # guards the status and the queue
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(1, "mapper")

    @property
    def grid(self) -> VoxelGrid:
        """The voxels of the uplink."""
        return self._grid

    def status(self) -> WorkerStatus:
        """A snapshot."""
        with self._lock:
            return self._status

    def assign(self, graph: TaskGraph) -> Future[None]:
        """Map for this task from the next frame on; the map stays, and earlier keyframes are looked at again.

        A task that asks the same as the one in force changes nothing. The future raises ModelFileError and the like.
        """
        return self.do(lambda _mapper: self._begin(graph))

    def resume(self, saved: SavedAgentMission) -> Future[None]:
        """Take up a mission where it was saved, before any frame is mapped. The future raises MapFileError."""
        return self._start(lambda: self._take_up(saved))

    def save(self, path: Path, terms: ResumeConfig, asked: str) -> Future[bool]:
        """Save the mission after the frame at hand, to be resumed in another life; False when there is no task yet.

        `asked` is the task of the command line. The future raises StorageError.
        """
        return self._start(lambda: self._save(path, terms, asked))

    def submit(self, frame: Frame) -> Future[FrameReport]:
        """Queue a frame. Raises MismatchError when there is no task yet, UnavailableError after `close`."""
        with self._lock:
            if self._status.graph is None:
                raise MismatchError("frames: expected a task first, got none yet; call AssignTask")
            come = _Waiting(frame, self._clock())
            self._waiting.append(come)
            dropped = self._overflow()
        if dropped is not None:
            reason = f"the queue of {self._load.queue_frames} frames was full; the {self._load.drops} gave way"
            dropped.future.set_result(self._count(FrameReport(dropped.frame.index, Outcome.DROPPED, reason)))
        self._start(self._map_next)
        return come.future

    def reject(self, index: int, reason: str) -> FrameReport:
        """Count a frame that was none."""
        return self._count(FrameReport(index, Outcome.REJECTED, reason))

    def do(self, function: Callable[[GaussianMapper], _Result]) -> Future[_Result]:
        """Run a function of the mapper on the worker, between two frames."""
        return self._start(lambda: function(self._mapper))

    def settle(self) -> Future[None]:
        """Rehearse no more until the next frame, and tell what rehearsing has changed."""
        return self._start(self._end_rest)

    def handover_words(self) -> Future[VoxelBatch]:
        """Words on the whole map, but for voxels of an earlier task's region that were told when trained more."""
        return self.do(lambda mapper: self._ledger.exclude_frozen(group_by_voxel(mapper.gaussians(), self._grid)))

    def revision(self) -> int:
        """The map's revision; it rises over restarts too."""
        return self.status().map_revision

    def close(self) -> None:
        """End the worker after the frame it is at; frames that wait are dropped."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        while self._waiting:
            left = self._waiting.popleft()
            left.future.set_result(self._count(FrameReport(left.frame.index, Outcome.DROPPED, "the agent is ending")))

    def _overflow(self) -> _Waiting | None:
        """The frame that is one too many for the queue; the lock is held."""
        if len(self._waiting) <= self._load.queue_frames:
            return None
        return self._waiting.popleft() if self._load.drops is Drops.OLDEST else self._waiting.pop()

    def _start(self, work: Callable[[], _Result]) -> Future[_Result]:
        try:
            return self._worker.submit(work)
        except RuntimeError as error:
            raise UnavailableError("agent: ending; no more work is taken") from error

    def _begin(self, graph: TaskGraph) -> None:
        now = self.status().graph
        if self._task_mapper is None:
            ledger = self._ledger if self.uplink is not None else None
            attention = self._make_attention(graph)
            scheduler = FrameScheduler(self._settings.scheduler_settings, self._clock)
            self._task_mapper = TaskMapper(attention, self._mapper, ledger, scheduler, self._tell)
        elif now is None or not graph.is_equivalent_to(now):
            self._task_mapper.assign(self._make_attention(graph))
        with self._lock:
            self._status = replace(self._status, graph=graph, notes=self._task_mapper.notes)

    def _take_up(self, saved: SavedAgentMission) -> None:
        self._begin(saved.life.graph)
        assert self._task_mapper is not None
        saved.run.restore(self._task_mapper)
        self._last_index = saved.life.last_index
        # also where the clock was set back between the two lives
        self._first_revision = max(self._first_revision, saved.life.map_revision + 1)
        with self._lock:
            revision = self._first_revision + self._mapper.revision
            self._status = replace(self._status, gaussians=self._mapper.count, map_revision=revision)
        # the spool lets go of what it has; the rest was on its way, or told later in a life that ended unsaved
        self._tell(self._ledger.exclude_frozen(group_by_voxel(self._mapper.roi_gaussians(), self._grid)))
        self._on_change()

    def _save(self, path: Path, terms: ResumeConfig, asked: str) -> bool:
        graph, loop = self.status().graph, self._task_mapper
        if graph is None or loop is None:
            return False
        life = MissionCheckpoint(self._last_index, graph, asked, self.revision())
        save_run(path, loop, terms, life.last_index, life.state())
        return True

    def _map_next(self) -> None:
        with self._lock:
            if not self._waiting:
                return
            next_one = self._waiting.popleft()
        try:
            next_one.future.set_result(self._map(next_one))
        except InvalidInputError as error:
            # the frames after it may be fine
            next_one.future.set_result(self.reject(next_one.frame.index, str(error)))
        except Exception as error:
            # the one who waits for this frame is told; the worker goes on
            next_one.future.set_exception(error)
        self._rehearsals_left = self._load.idle_iterations
        if not self._resting and self._rehearsals_left > 0:
            self._rest()

    def _rest(self) -> None:
        """One iteration while no frame waits, then this again, behind all work that has come meanwhile.

        An error ends it until the next frame has been mapped: nobody waits for this, so it is logged.
        """
        with self._lock:
            self._resting = not self._waiting
        if not self._resting:
            return
        try:
            self._rehearse()
        except Exception:
            _log.exception("an idle iteration failed; the next frame is followed by others")
            self._rehearsals_left, self._resting = 0, False

    def _rehearse(self) -> None:
        assert self._task_mapper is not None
        if self._rehearsals_left == 0 or not self._task_mapper.idle_step():
            self._end_rest()
            return
        self._rehearsals_left -= 1
        self._untold = True
        with self._lock:
            self._status = replace(self._status, idle_iterations=self._status.idle_iterations + 1)
        # the executor takes no more work once the robot is closing
        with suppress(UnavailableError):
            self._start(self._rest)

    def _end_rest(self) -> None:
        self._rehearsals_left, self._resting = 0, False
        if not self._untold or self._task_mapper is None:
            return
        self._untold = False
        words = self._task_mapper.changed_roi()
        if words is not None:
            self._tell(words)

    def _map(self, come: _Waiting) -> FrameReport:
        assert self._task_mapper is not None
        frame = come.frame
        done = self._task_mapper.process(frame, self._clock() - come.since_s)
        self._last_index = frame.index
        with self._lock:
            self._status = replace(self._status, notes=self._task_mapper.notes)
        if done.skipped is not None:
            return self._count(FrameReport(frame.index, Outcome.SKIPPED, done.skipped, gaussians=done.gaussians))
        if done.changed_roi is not None:
            self._untold = False
        report = FrameReport(
            frame.index,
            Outcome.MAPPED,
            iterations=done.iterations,
            gaussians=done.gaussians,
            roi_share=done.roi_share,
            seconds=done.timing.seconds,
            age_s=self._clock() - come.since_s,
        )
        self._note_load(done)
        self._count(report)
        self._on_change()
        return report

    def _tell(self, words: VoxelBatch) -> None:
        """Give words to the uplink. A spool without room ends no mission: all is told again once it has some."""
        if self.uplink is None:
            return
        untold_because = ""
        try:
            self.uplink.enqueue(words)
        except StorageError as error:
            untold_because = str(error)
            self._ledger.mark_all_unsent()
        with self._lock:
            before = self._status.untold_because
            self._status = replace(self._status, untold_because=untold_because)
        if untold_because and not before:
            _log.warning("%s", untold_because)

    def _note_load(self, done: FrameOutcome) -> None:
        with self._lock:
            status = self._status
            self._status = replace(
                status,
                short=status.short + done.timing.under_trained,
                without_words=status.without_words + (SkippableStage.PUBLISHING in done.timing.skipped_stages),
                without_seeding=status.without_seeding + (SkippableStage.SEEDING in done.timing.skipped_stages),
                max_detection_lag=max(status.max_detection_lag, done.detection_lag_frames or 0),
                reread=status.reread + done.reevaluation.keyframes,
            )

    def _count(self, report: FrameReport) -> FrameReport:
        with self._lock:
            revision = self._first_revision + self._mapper.revision
            self._status = replace(self._status.plus(report), map_revision=revision)
        return report
