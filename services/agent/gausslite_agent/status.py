"""What a robot says of a frame and of itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from gausslite.domain.task import TaskGraph

_AGES_KEPT = 1000


class Outcome(Enum):
    """What became of a frame."""

    MAPPED = "mapped"
    SKIPPED = "skipped"
    DROPPED = "dropped"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class FrameReport:
    """The outcome of one frame; reason says why it was not mapped.

    seconds is what it took, age_s how long ago it had come when it was mapped, its wait in the queue included.
    """

    index: int
    outcome: Outcome
    reason: str = ""
    iterations: int = 0
    gaussians: int = 0
    roi_share: float = 0.0
    seconds: float = 0.0
    age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """Totals so far; busy_s is the time spent on perception and mapping, notes what the attention has to say.

    short counts the frames that trained less than they should, without_* those that went without something for want
    of time; max_detection_lag is the greatest age, in frames, at which a detection came; reread counts the keyframes
    that were looked at again for a new task. untold_because says why the uplink could not take the newest words.
    ages_s are those of the latest mapped frames.
    """

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
    idle_iterations: int = 0
    short: int = 0
    without_words: int = 0
    without_seeding: int = 0
    max_detection_lag: int = 0
    reread: int = 0
    untold_because: str = ""
    ages_s: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def load_notes(self) -> tuple[str, ...]:
        """What was left undone for want of time or of room, one line each."""
        told = (
            (self.dropped, "frames were dropped"),
            (self.short, "frames trained too little"),
            (self.without_words, "frames told their words later"),
            (self.without_seeding, "frames were not seeded"),
        )
        overload = tuple(f"overload: {count} {what}" for count, what in told if count)
        return (*overload, f"nothing more is told: {self.untold_because}") if self.untold_because else overload

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping."""
        return self.mapped / self.busy_s if self.busy_s > 0 else 0.0

    @property
    def roi_share(self) -> float:
        """Mean share of the pixels in the task's region."""
        return self.roi_share_sum / max(self.mapped, 1)

    def age_s(self, percent: float) -> float:
        """The age that so many of the latest frames had not passed when they were mapped; 0 before the first."""
        return float(np.percentile(self.ages_s, percent)) if self.ages_s else 0.0

    def plus(self, report: FrameReport) -> WorkerStatus:
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
            ages_s=(*self.ages_s[1 - _AGES_KEPT :], report.age_s),
        )
