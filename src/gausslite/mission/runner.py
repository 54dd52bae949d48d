"""The frame loop of every mission: read a frame, process it, report it, until the end or an interrupt."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.frame import Frame
from gausslite.mission.task_mapper import TRACKING_LOST, FrameOutcome
from gausslite.process.interrupts import DeferredInterrupt

_NO_FRAME_INDEX = -1


@dataclass(slots=True)
class MissionTotals:
    """Sums over the frames of a mission.

    frames: mapped ones; late: those of them that missed their deadline. skipped: frames without depth, and those that
    tracking has lost, which `lost` counts alone.
    """

    frames: int = 0
    skipped: int = 0
    lost: int = 0
    late: int = 0
    iterations: int = 0
    keyframes_reevaluated: int = 0
    seeded_in_keyframes: int = 0
    roi_share_sum: float = 0.0
    busy_s: float = 0.0
    region_seen: bool = False

    def add(self, outcome: FrameOutcome) -> None:
        """Add one frame."""
        self.keyframes_reevaluated += outcome.reevaluation.keyframes
        self.seeded_in_keyframes += outcome.reevaluation.seeded
        self.region_seen |= outcome.roi_share > 0
        if outcome.skipped is not None:
            self.skipped += 1
            self.lost += outcome.skipped == TRACKING_LOST
            return
        self.frames += 1
        self.late += outcome.timing.late
        self.iterations += outcome.iterations
        self.roi_share_sum += outcome.roi_share
        self.busy_s += outcome.timing.seconds


@dataclass(frozen=True, slots=True)
class MissionResult:
    """Result of a mission.

    totals: sums over its frames; seconds: wall time; last_index: index of the last processed frame, or the index that
    the run was resumed after; stopped_by: the error or interrupt that ended it early.
    """

    totals: MissionTotals
    seconds: float
    last_index: int
    stopped_by: GaussLiteError | KeyboardInterrupt | None

    @property
    def processed(self) -> int:
        """Number of frames, including skipped ones."""
        return self.totals.frames + self.totals.skipped

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping, without reading files."""
        return self.totals.frames / self.totals.busy_s if self.totals.busy_s > 0 else 0.0

    def raise_if_stopped(self) -> None:
        """Raise the error or interrupt that ended the mission early."""
        if self.stopped_by is not None:
            raise self.stopped_by

    def summary(self) -> dict[str, object]:
        """Return the totals as part of a report."""
        totals = self.totals
        return {
            "frames": totals.frames,
            "frames_skipped": totals.skipped,
            "frames_late": totals.late,
            "iterations": totals.iterations,
            "roi_share": totals.roi_share_sum / max(totals.frames, 1),
            "keyframes_reread": totals.keyframes_reevaluated,
            "seeded_in_keyframes": totals.seeded_in_keyframes,
            "hz": self.hz,
            "seconds": self.seconds,
            "stopped_by": None if self.stopped_by is None else str(self.stopped_by) or "interrupted",
        }


def _ignore(outcome: FrameOutcome) -> None:
    del outcome


@dataclass(frozen=True, slots=True)
class MissionRunner:
    """Pass frames to a processing step, one after the other.

    process: maps one frame, or queues it elsewhere and returns None. on_frame: gets each outcome, for progress.
    checkpoint: gets the index of the last frame when the run ends, unless an error came before the first frame.
    should_stop: called before each frame; the run ends if it returns True. Publishing is part of the processing step,
    see `TaskMapper`.
    """

    process: Callable[[Frame], FrameOutcome | None]
    on_frame: Callable[[FrameOutcome], None] = _ignore
    checkpoint: Callable[[int], None] | None = None
    should_stop: Callable[[], bool] = field(default=lambda: False)

    def run(self, frames: Iterable[Frame], resumed_after: int = _NO_FRAME_INDEX) -> MissionResult:
        """Process all frames. Ctrl-C and SIGTERM end the run after the current frame.

        An error of the frames or of the processing step ends the run too; the result holds it.
        """
        start_s = time.perf_counter()
        totals, last_index = MissionTotals(), resumed_after
        stopped_by: GaussLiteError | KeyboardInterrupt | None = None
        source = iter(frames)
        with DeferredInterrupt() as interrupt:
            while not self.should_stop():
                if interrupt.pending_exception is not None:
                    stopped_by = interrupt.pending_exception
                    break
                try:
                    frame = next(source, None)
                    if frame is None:
                        break
                    outcome = self.process(frame)
                except GaussLiteError as error:
                    stopped_by = error
                    break
                last_index = frame.index
                if outcome is not None:
                    totals.add(outcome)
                    self.on_frame(outcome)
        result = MissionResult(totals, time.perf_counter() - start_s, last_index, stopped_by)
        if self.checkpoint is not None and (result.processed > 0 or stopped_by is None):
            self.checkpoint(last_index)
        return result
