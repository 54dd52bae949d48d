"""The state of an agent's mission: its phases, counters and end, and how it is saved and read."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from gausslite.domain.errors import GaussLiteError, InvalidInputError, MapFileError, MismatchError
from gausslite.domain.objects import NounReport, ObjectLandmark
from gausslite.domain.pose import PoseCorrection
from gausslite.domain.state import State, encode_text, get_array, get_counts, get_text, int_array
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.checkpoint import SavedRun
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.process import size_text
from gausslite.v1 import task_pb2
from gausslite.wire.convert_task import graph_from_message, graph_to_message
from gausslite.wire.update_sender import UplinkCounters

MAX_DRAIN_S = 86400.0
_AGES_KEPT = 1000


@dataclass(frozen=True, slots=True)
class MissionCheckpoint:
    """A mission at the time it was saved."""

    last_index: int  # index of its last frame
    graph: TaskGraph  # its task
    requested_task: str  # the task of the command line
    map_revision: int  # the latest revision that was sent to watchers

    def state(self) -> State:
        """Return the arrays that are saved with the mapping run."""
        data = graph_to_message(self.graph).SerializeToString()
        return {
            "graph": np.frombuffer(data, np.uint8),
            "requested_task": encode_text(self.requested_task),
            "map_revision": int_array(self.map_revision),
        }


@dataclass(frozen=True, slots=True)
class SavedMission:
    """A mission read from a file. It is as large as the map and its keyframes; release it after `restore`."""

    run: SavedRun
    checkpoint: MissionCheckpoint

    @classmethod
    def read(cls, path: Path, *settings: Any) -> SavedMission:
        """Read a saved mission. Raises MapFileError for another file, MismatchError for one of other settings."""
        run = SavedRun.read(path)
        run.require(*settings)
        try:
            data = get_array(run.extra, "graph", (None,), np.uint8).tobytes()
            graph = graph_from_message(task_pb2.TaskGraph.FromString(data))
            [map_revision] = get_counts(run.extra, "map_revision", 1)
            requested_task = get_text(run.extra, "requested_task")
        except (GaussLiteError, DecodeError) as error:
            raise MapFileError(f"{path}: expected the state of an agent's mission: {error}") from error
        return cls(run, MissionCheckpoint(run.last_index, graph, requested_task, map_revision))


@dataclass(frozen=True, slots=True)
class EndRequest:
    """How a mission is to end."""

    handover: bool  # also send the rest of the map
    drain_s: float  # the longest time for sending

    def __post_init__(self) -> None:
        if not (math.isfinite(self.drain_s) and 0 <= self.drain_s <= MAX_DRAIN_S):
            raise InvalidInputError(f"drain_seconds: expected 0 to {MAX_DRAIN_S:.0f}, got {self.drain_s}")


@dataclass(frozen=True, slots=True)
class MissionSummary:
    """The figures of a mission that has ended."""

    frames: int  # mapped ones
    hz: float  # mapped frames per second of their processing
    gaussians: int
    ended_by: str | None  # why it ended early, None after its regular end
    uplink: UplinkCounters | None  # None without a fusion server
    spool: Path | None  # file of the data that was left, None if it is in memory

    @property
    def is_complete(self) -> bool:
        """True if the server has acknowledged everything."""
        uplink = self.uplink
        return uplink is None or (uplink.voxels_waiting == 0 and uplink.keyframes_waiting == 0)

    def line(self) -> str:
        """Return one line for the operator: what was mapped, what was sent, what was left and where it is."""
        ending = "ended" if self.ended_by is None else f"ended early ({self.ended_by})"
        mapped = f"mission {ending}: {self.frames} frames at {self.hz:.2f} Hz, {self.gaussians:,} Gaussians"
        uplink = self.uplink
        if uplink is None:
            return mapped
        sent = (
            f"{uplink.voxels_sent:,} voxels of the task's region in {size_text(uplink.roi_bytes)}, "
            f"{uplink.keyframes_sent} keyframes in {size_text(uplink.keyframe_bytes)}, "
            f"a handover of {size_text(uplink.handover_bytes)}"
        )
        if self.is_complete:
            return f"{mapped}; sent {sent}; nothing was left"
        stays = f"in {self.spool} until the agent runs again" if self.spool is not None else "lost when the agent ends"
        left = f"{uplink.voxels_waiting} voxels and {uplink.keyframes_waiting} keyframes"
        return f"{mapped}; sent {sent}; left {left}, {stays}"


class MissionState(Enum):
    """State of a mission. DRAINING sends the region's updates and the keyframes, HANDING_OVER the rest of the map."""

    WAITING_FOR_TASK = "waiting for task"
    MAPPING = "mapping"
    DRAINING = "draining"
    HANDING_OVER = "handing over"
    ENDED = "ended"
    FAILED = "failed"


_ENDING = frozenset({MissionState.DRAINING, MissionState.HANDING_OVER})
_FOLLOWING = {
    MissionState.WAITING_FOR_TASK: {MissionState.MAPPING, MissionState.FAILED},
    MissionState.MAPPING: {MissionState.DRAINING, MissionState.FAILED},
    MissionState.DRAINING: {MissionState.HANDING_OVER, MissionState.ENDED, MissionState.FAILED},
    MissionState.HANDING_OVER: {MissionState.ENDED, MissionState.FAILED},
    MissionState.ENDED: {MissionState.MAPPING},
    MissionState.FAILED: {MissionState.MAPPING, MissionState.DRAINING},
}


class MissionStateMachine:
    """The current state of the mission. Thread-safe."""

    def __init__(self) -> None:
        self.state = MissionState.WAITING_FOR_TASK
        """The current state."""
        self.failure = ""
        """The error that ended the mission; empty unless FAILED."""
        self._lock = threading.Lock()

    def enter(self, state: MissionState, failure: str = "") -> None:
        """Enter this state. Raises MismatchError if it cannot follow the current one; failure: the error of FAILED."""
        with self._lock:
            if state not in _FOLLOWING[self.state]:
                raise MismatchError(f"mission: expected a state that can follow {self.state.value}, got {state.value}")
            self.state, self.failure = state, failure

    def require_accepting(self, what: str) -> None:
        """Raise MismatchError while the mission ends; what: the data that it would have accepted."""
        if (state := self.state) in _ENDING:
            raise MismatchError(f"{what}: expected a mission that accepts it, got one that is {state.value}")

    def require_mapping(self) -> None:
        """Raise MismatchError if frames cannot be mapped now."""
        if (state := self.state) is not MissionState.MAPPING:
            raise MismatchError(
                f"frames: expected a mission that is mapping, got one that is {state.value}; call AssignTask"
            )


class Outcome(Enum):
    """Result of a frame."""

    MAPPED = "mapped"
    SKIPPED = "skipped"
    DROPPED = "dropped"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class FrameReport:
    """The outcome of one frame."""

    index: int  # number in the sequence
    outcome: Outcome
    reason: str = ""  # why it was not mapped
    iterations: int = 0  # of training
    gaussians: int = 0  # in the map afterwards
    roi_share: float = 0.0  # of the pixels
    seconds: float = 0.0  # its processing time
    age_s: float = 0.0  # time from its arrival until it was mapped, including its wait in the queue


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """Totals since the start of the agent.

    under_trained, publishing_skipped, seeding_skipped: frames whose time was too short for all of it. correction: the
    odometry's latest correction, mapped at corrected_at_s of the monotonic clock.
    """

    graph: TaskGraph | None = None  # of the current task
    map_revision: int = 0  # grows with each change of the map
    gaussians: int = 0  # in the map
    mapped: int = 0
    joined: int = 0  # those of them that were mapped apart, without the task
    skipped: int = 0  # frames with a defect or without a place
    dropped: int = 0  # frames that newer ones replaced in the queue
    rejected: int = 0  # invalid frames
    iterations: int = 0
    busy_s: float = 0.0  # time of perception and mapping
    roi_share_sum: float = 0.0  # over the mapped frames; divided by their number, the mean
    idle_iterations: int = 0  # iterations while no frame waited
    under_trained: int = 0
    publishing_skipped: int = 0
    seeding_skipped: int = 0
    max_detection_lag: int = 0  # longest delay of a detection, in frames
    keyframes_reevaluated: int = 0  # keyframes evaluated for a new task
    publish_error: str = ""  # why the uplink refused the newest changes
    ages_s: tuple[float, ...] = ()  # ages of the latest mapped frames
    notes: tuple[str, ...] = ()  # messages of the relevance estimator
    correction: PoseCorrection | None = None
    corrected_at_s: float = 0.0
    objects: tuple[ObjectLandmark, ...] = ()  # the confirmed objects, as people have corrected them
    found: tuple[ObjectLandmark, ...] = ()  # the same before any correction
    nouns: tuple[NounReport, ...] = ()  # what is searched for each noun, and what was detected
    team_gaussians: int = 0  # Gaussians inserted from the fused map
    localisation: LocalisationState = LocalisationState.TRACKED  # of the robot

    @property
    def noun_notes(self) -> tuple[str, ...]:
        """One line for each noun that is searched: its class, detections and best score."""
        return tuple(noun.describe() for noun in self.nouns if noun.match.is_searched)

    @property
    def task_notes(self) -> tuple[str, ...]:
        """What of the task is not understood, and one line for each target if no frame has shown the task's region."""
        unread = () if self.graph is None else (line for line in self.graph.warnings if line not in self.notes)
        targets = () if self.graph is None or self.has_found_task else self.graph.targets
        return (*unread, *(f"target {target!r} was not found in {self.mapped} frames" for target in targets))

    @property
    def has_found_task(self) -> bool:
        """False if frames were mapped with a task, and no frame and no object shows a target of it."""
        targets = set() if self.graph is None else {noun_of(target) for target in self.graph.targets}
        is_known = any(landmark.noun in targets for landmark in self.objects)
        return not targets or self.mapped == 0 or self.roi_share_sum > 0 or is_known

    @property
    def load_notes(self) -> tuple[str, ...]:
        """One line for each kind of work that was dropped for lack of time or space."""
        counts = (
            (self.dropped, "frames were dropped"),
            (self.under_trained, "frames trained fewer iterations than they should"),
            (self.publishing_skipped, "frames published their changes with a later frame"),
            (self.seeding_skipped, "frames were not seeded"),
        )
        overload = tuple(f"overload: {count} {effect}" for count, effect in counts if count)
        return (*overload, f"changes are not published: {self.publish_error}") if self.publish_error else overload

    @property
    def hz(self) -> float:
        """Mapped frames per second of perception and mapping."""
        return (self.mapped - self.joined) / self.busy_s if self.busy_s > 0 else 0.0

    @property
    def roi_share(self) -> float:
        """Mean share of the pixels in the task's region."""
        return self.roi_share_sum / max(self.mapped - self.joined, 1)

    def age_s(self, percent: float) -> float:
        """Return the percentile of the latest frames' ages; 0 before the first."""
        return float(np.percentile(self.ages_s, percent)) if self.ages_s else 0.0

    def with_mapped(self, outcome: FrameOutcome, age_s: float) -> WorkerStatus:
        """Return the totals with one more mapped frame."""
        timing = outcome.timing
        return replace(
            self,
            mapped=self.mapped + 1,
            gaussians=outcome.gaussians,
            iterations=self.iterations + outcome.iterations,
            busy_s=self.busy_s + timing.seconds,
            roi_share_sum=self.roi_share_sum + outcome.roi_share,
            ages_s=(*self.ages_s[1 - _AGES_KEPT :], age_s),
            under_trained=self.under_trained + timing.under_trained,
            publishing_skipped=self.publishing_skipped + (SkippableStage.PUBLISHING in timing.skipped_stages),
            seeding_skipped=self.seeding_skipped + (SkippableStage.SEEDING in timing.skipped_stages),
            max_detection_lag=max(self.max_detection_lag, outcome.detection_lag_frames or 0),
            keyframes_reevaluated=self.keyframes_reevaluated + outcome.reevaluation.keyframes,
        )


class StatusHolder:
    """The current WorkerStatus. Thread-safe: frames are counted on the worker and where they arrive."""

    def __init__(self, status: WorkerStatus) -> None:
        self.status = status
        """The current one."""
        self._lock = threading.Lock()

    def update(self, **changes: Any) -> None:
        """Replace these fields."""
        with self._lock:
            self.status = replace(self.status, **changes)

    def count(self, report: FrameReport, map_revision: int, outcome: FrameOutcome | None = None) -> None:
        """Count one frame; outcome: that of a mapped one."""
        with self._lock:
            if outcome is not None:
                joined = min(outcome.joined, self.status.skipped)
                skipped = self.status.skipped + 1 - joined - len(outcome.mapped)
                mapped, joined = self.status.mapped + joined, self.status.joined + joined
                status = replace(self.status, mapped=mapped, joined=joined, skipped=skipped)
                for placed in outcome.mapped:
                    status = status.with_mapped(placed, report.age_s)
            else:
                kind = report.outcome.value
                status = replace(self.status, **{kind: getattr(self.status, kind) + 1})
            self.status = replace(status, map_revision=map_revision)
