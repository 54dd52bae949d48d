"""One robot's mapper on one worker thread, with a short queue of frames before it.

When frames come faster than they are mapped the OLDEST waiting one is dropped and says so: a live robot wants the
newest view. Everything that touches the map runs on the worker, so the mapper needs no lock.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeVar

from gausslite.domain.frame import Frame
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import MismatchError, UnavailableError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pace import Pace
from gausslite.mapping.roi import RoiLedger
from gausslite.mission.build import build_mapper
from gausslite.mission.settings import MissionSettings
from gausslite.perception.attention import Attention
from gausslite.pipeline import TaskMapper
from gausslite.wire.uplink import Uplink

_Result = TypeVar("_Result")


class Outcome(Enum):
    """What became of a frame."""

    MAPPED = "mapped"
    SKIPPED = "skipped"
    DROPPED = "dropped"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class FrameReport:
    """The outcome of one frame; reason says why it was not mapped."""

    index: int
    outcome: Outcome
    reason: str = ""
    iterations: int = 0
    gaussians: int = 0
    roi_share: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """Totals so far; busy_s is the time spent on perception and mapping, notes what the attention has to say."""

    graph: TaskGraph | None = None
    map_revision: int = 0
    gaussians: int = 0
    mapped: int = 0
    skipped: int = 0
    dropped: int = 0
    rejected: int = 0
    iterations: int = 0
    busy_s: float = 0.0
    roi_share_sum: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping."""
        return self.mapped / self.busy_s if self.busy_s > 0 else 0.0

    @property
    def roi_share(self) -> float:
        """Mean share of the pixels in the task's region."""
        return self.roi_share_sum / max(self.mapped, 1)

    def plus(self, report: FrameReport) -> RobotStatus:
        """The totals with one more frame."""
        if report.outcome is not Outcome.MAPPED:
            return replace(self, **{report.outcome.value: getattr(self, report.outcome.value) + 1})
        return replace(
            self,
            mapped=self.mapped + 1,
            gaussians=report.gaussians,
            iterations=self.iterations + report.iterations,
            busy_s=self.busy_s + report.seconds,
            roi_share_sum=self.roi_share_sum + report.roi_share,
        )


class Robot:
    """Owns the map and the worker thread. `attention` makes what attends to a task; it runs on the worker."""

    def __init__(
        self,
        settings: MissionSettings,
        grid: VoxelGrid,
        attention: Callable[[TaskGraph], Attention],
        uplink: Uplink | None = None,
        on_change: Callable[[], None] = lambda: None,
        queue_frames: int = 4,
    ) -> None:
        """Reserve the map's memory. on_change is called on the worker after each mapped frame."""
        self._settings, self._grid, self._make_attention = settings, grid, attention
        self.uplink = uplink
        self._on_change = on_change
        self._queue_frames = queue_frames
        self._mapper = build_mapper(settings)
        self._ledger = RoiLedger(grid)
        self._task_mapper: TaskMapper | None = None
        # revisions of an earlier life must not be taken for ones of this
        self._first_revision = time.time_ns() // 1000
        self._status = RobotStatus(map_revision=self._first_revision)
        self._waiting: deque[tuple[Frame, Future[FrameReport]]] = deque()
        # guards the status and the queue
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(1, "mapper")

    @property
    def grid(self) -> VoxelGrid:
        """The voxels of the uplink."""
        return self._grid

    def status(self) -> RobotStatus:
        """A snapshot."""
        with self._lock:
            return self._status

    def assign(self, graph: TaskGraph) -> Future[None]:
        """Map for this task from the next frame on; the map stays. The future raises ModelFileError and the like."""
        return self.do(lambda _mapper: self._begin(graph))

    def submit(self, frame: Frame) -> Future[FrameReport]:
        """Queue a frame. Raises MismatchError when there is no task yet, UnavailableError after `close`."""
        with self._lock:
            if self._status.graph is None:
                raise MismatchError("frames: expected a task first, got none yet; call AssignTask")
            overtaken = self._waiting.popleft() if len(self._waiting) >= self._queue_frames else None
            future: Future[FrameReport] = Future()
            self._waiting.append((frame, future))
        if overtaken is not None:
            reason = f"the queue of {self._queue_frames} frames was full; a newer frame took its place"
            overtaken[1].set_result(self._count(FrameReport(overtaken[0].index, Outcome.DROPPED, reason)))
        self._start(self._map_next)
        return future

    def reject(self, index: int, reason: str) -> FrameReport:
        """Count a frame that was none."""
        return self._count(FrameReport(index, Outcome.REJECTED, reason))

    def do(self, function: Callable[[GaussianMapper], _Result]) -> Future[_Result]:
        """Run a function of the mapper on the worker, between two frames."""
        return self._start(lambda: function(self._mapper))

    def revision(self) -> int:
        """The map's revision; it rises over restarts too."""
        return self.status().map_revision

    def close(self) -> None:
        """End the worker after the frame it is at; frames that wait are dropped."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        while self._waiting:
            frame, future = self._waiting.popleft()
            future.set_result(self._count(FrameReport(frame.index, Outcome.DROPPED, "the agent is ending")))

    def _start(self, work: Callable[[], _Result]) -> Future[_Result]:
        try:
            return self._worker.submit(work)
        except RuntimeError as error:
            raise UnavailableError("agent: ending; no more work is taken") from error

    def _begin(self, graph: TaskGraph) -> None:
        attention = self._make_attention(graph)
        ledger = self._ledger if self.uplink is not None else None
        self._task_mapper = TaskMapper(attention, self._mapper, ledger, Pace(self._settings.pace))
        with self._lock:
            self._status = replace(self._status, graph=graph, notes=attention.notes)

    def _map_next(self) -> None:
        with self._lock:
            if not self._waiting:
                return
            frame, future = self._waiting.popleft()
        try:
            future.set_result(self._map(frame))
        except Exception as error:
            # the one who waits for this frame is told; the worker goes on
            future.set_exception(error)

    def _map(self, frame: Frame) -> FrameReport:
        assert self._task_mapper is not None
        done = self._task_mapper.process(frame)
        with self._lock:
            self._status = replace(self._status, notes=self._task_mapper.notes)
        if done.skipped is not None:
            return self._count(FrameReport(frame.index, Outcome.SKIPPED, done.skipped, gaussians=done.gaussians))
        if self.uplink is not None and done.words is not None:
            self.uplink.offer(done.words)
        report = FrameReport(
            frame.index, Outcome.MAPPED, "", done.iterations, done.gaussians, done.roi_share, done.budget.seconds
        )
        self._count(report)
        self._on_change()
        return report

    def _count(self, report: FrameReport) -> FrameReport:
        with self._lock:
            revision = self._first_revision + self._mapper.revision
            self._status = replace(self._status.plus(report), map_revision=revision)
        return report
