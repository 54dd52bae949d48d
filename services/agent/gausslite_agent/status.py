"""The outcome of each frame, and the totals of the mapping worker."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from gausslite.domain.noun_match import NounReport
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose_correction import PoseCorrection
from gausslite.domain.task import TaskGraph
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.task_mapper import FrameOutcome

_AGES_KEPT = 1000


class Outcome(Enum):
    """Result of a frame."""

    MAPPED = "mapped"
    SKIPPED = "skipped"
    DROPPED = "dropped"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class FrameReport:
    """The outcome of one frame; reason: why it was not mapped.

    seconds: its processing time; age_s: time from its arrival until it was mapped, including its wait in the queue.
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
    """Totals since the start of the agent.

    busy_s: time of perception and mapping. under_trained, publishing_skipped, seeding_skipped: frames whose time was
    too short for all of it. max_detection_lag: longest delay of a detection, in frames. keyframes_reevaluated:
    keyframes evaluated for a new task. publish_error: why the uplink refused the newest changes. ages_s: ages of the
    latest mapped frames. correction: the odometry's latest correction, mapped at corrected_at_s of the monotonic clock.
    notes: messages of the relevance estimator. objects: the confirmed objects of the task. nouns: what is searched for
    each noun, and what was detected. team_gaussians: Gaussians inserted from the fused map.
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
    under_trained: int = 0
    publishing_skipped: int = 0
    seeding_skipped: int = 0
    max_detection_lag: int = 0
    keyframes_reevaluated: int = 0
    publish_error: str = ""
    ages_s: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    correction: PoseCorrection | None = None
    corrected_at_s: float = 0.0
    objects: tuple[ObjectLandmark, ...] = ()
    nouns: tuple[NounReport, ...] = ()
    team_gaussians: int = 0

    @property
    def noun_notes(self) -> tuple[str, ...]:
        """One line for each noun that is searched: its class, detections and best score."""
        return tuple(each.describe() for each in self.nouns if each.match.is_searched)

    @property
    def task_notes(self) -> tuple[str, ...]:
        """One line if no frame has shown the task's region."""
        if self.mapped == 0 or self.graph is None or self.roi_share_sum > 0:
            return ()
        return (f"the task's targets were not found in {self.mapped} frames: {', '.join(self.graph.targets)}",)

    @property
    def load_notes(self) -> tuple[str, ...]:
        """One line for each kind of work that was dropped for lack of time or space."""
        counts = (
            (self.dropped, "frames were dropped"),
            (self.under_trained, "frames trained fewer iterations than min-iterations"),
            (self.publishing_skipped, "frames published their changes with a later frame"),
            (self.seeding_skipped, "frames were not seeded"),
        )
        overload = tuple(f"overload: {count} {effect}" for count, effect in counts if count)
        return (*overload, f"changes are not published: {self.publish_error}") if self.publish_error else overload

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping."""
        return self.mapped / self.busy_s if self.busy_s > 0 else 0.0

    @property
    def roi_share(self) -> float:
        """Mean share of the pixels in the task's region."""
        return self.roi_share_sum / max(self.mapped, 1)

    def age_s(self, percent: float) -> float:
        """Return the percentile of the latest frames' ages; 0 before the first."""
        return float(np.percentile(self.ages_s, percent)) if self.ages_s else 0.0

    def with_report(self, report: FrameReport) -> WorkerStatus:
        """Return the totals with one more frame."""
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

    def with_outcome(self, outcome: FrameOutcome) -> WorkerStatus:
        """Return the totals with the skipped stages, detections and keyframes of one mapped frame."""
        skipped = outcome.timing.skipped_stages
        return replace(
            self,
            under_trained=self.under_trained + outcome.timing.under_trained,
            publishing_skipped=self.publishing_skipped + (SkippableStage.PUBLISHING in skipped),
            seeding_skipped=self.seeding_skipped + (SkippableStage.SEEDING in skipped),
            max_detection_lag=max(self.max_detection_lag, outcome.detection_lag_frames or 0),
            keyframes_reevaluated=self.keyframes_reevaluated + outcome.reevaluation.keyframes,
        )


class StatusHolder:
    """The current WorkerStatus, for the worker and for the readers on other threads."""

    def __init__(self, status: WorkerStatus) -> None:
        self._status = status
        self._lock = threading.Lock()

    def get(self) -> WorkerStatus:
        """Return the current status."""
        with self._lock:
            return self._status

    def update(self, **changes: Any) -> None:
        """Replace these fields."""
        with self._lock:
            self._status = replace(self._status, **changes)

    def add_report(self, report: FrameReport, map_revision: int) -> None:
        """Count one frame."""
        with self._lock:
            self._status = replace(self._status.with_report(report), map_revision=map_revision)

    def add_outcome(self, outcome: FrameOutcome) -> None:
        """Count what one mapped frame skipped, detected and re-evaluated."""
        with self._lock:
            self._status = self._status.with_outcome(outcome)

    def add_idle_iteration(self) -> None:
        """Count one idle iteration."""
        with self._lock:
            self._status = replace(self._status, idle_iterations=self._status.idle_iterations + 1)
