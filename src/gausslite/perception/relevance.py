"""Estimate w(u, v) for a task (Sec. III-B): detect on keyframes, propagate to other frames, filter by 3D relations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame, FrameId
from gausslite.domain.objects import NounReport, ObjectLandmark, match_warnings
from gausslite.domain.relevance import NO_TARGET, DetectedImage, Detection, PointM, Region, RelevanceMap
from gausslite.domain.state import State
from gausslite.domain.task import TaskGraph
from gausslite.perception.detector import Detector
from gausslite.perception.lifting import best_depth_m
from gausslite.perception.object_map import Landmark
from gausslite.perception.relevance_tracker import RelevanceTracker
from gausslite.perception.settings import RelevanceTrackerSettings


@dataclass(frozen=True, slots=True, eq=False)
class DelayedRelevance:
    """The relevance of an earlier frame, from a detection that finished lag_frames frames after that frame."""

    frame: FrameId
    relevance: RelevanceMap
    lag_frames: int


@dataclass(frozen=True, slots=True, eq=False)
class RelevanceEstimate:
    """The relevance of a frame, and that of an earlier frame if its detection has finished since the last call."""

    relevance: RelevanceMap
    delayed: DelayedRelevance | None = None
    detected: DetectedImage | None = None  # what that detection found, or one on this frame; None if none has finished


class RelevanceEstimator(ABC):
    """Estimates which pixels of each frame are relevant to the task.

    All members but `estimate` are those of an estimator whose frames are independent and that detects nothing.
    """

    @abstractmethod
    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return the relevance of one frame. rendered_depth_m is rendered from the current map, 0 where it is empty."""

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        """Return this task's relevance of an earlier frame; None while its detection runs, then call again.

        The caller proceeds from the newest frame to the oldest, one at a time.
        """
        return self.estimate(frame).relevance

    @property
    def known_objects(self) -> int:
        """The number of the task's objects that relevance maps include from now on."""
        return 0

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return an earlier frame's relevance with the objects that became known since, without a detection."""
        del frame
        return relevance

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator about the frames so far, one line each."""
        return ()

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the task so far; empty if the estimator has no object map."""
        return ()

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """What is searched for each noun of the task, and what was detected; empty without a detector."""
        return ()

    def point_at(self, noun: str, mask: Bool[ndarray, "h w"], frame: Frame) -> None:
        """Add the object that a person points at, by its mask on a frame. Raises InvalidInputError."""
        del mask, frame
        raise InvalidInputError(f"pointed object: expected a task, to which {noun!r} belongs, got none")

    def exclude(self, point_m: PointM) -> None:
        """Leave out the object at a point in the world. Raises InvalidInputError."""
        del point_m
        raise InvalidInputError("excluded: expected a task with objects, got none")

    def state(self) -> State:
        """Return everything that the next frame's relevance depends on, except the frame, as named arrays."""
        return {}

    def restore(self, state: State) -> None:
        """Replace the state by that of an estimator of the same task. Raises MapFileError, InvalidInputError."""
        del state


class NoTaskEstimator(RelevanceEstimator):
    """A RelevanceEstimator for uniform maps: no pixel is relevant."""

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 0 everywhere."""
        del rendered_depth_m
        return RelevanceEstimate(RelevanceMap.empty(*frame.depth_m.shape))


class RegionRelevanceEstimator(RelevanceEstimator):
    """A RelevanceEstimator that marks given regions; region i is target i, and the first wins in an overlap."""

    def __init__(self, regions: Sequence[Region]) -> None:
        if not regions:
            raise InvalidInputError("regions: expected at least one region, got none")
        self._regions = tuple(regions)

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 1 on every pixel that shows a region; the rendered depth is not needed."""
        del rendered_depth_m
        target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
        for index, region in reversed(list(enumerate(self._regions))):
            target[region.mask(frame)] = index
        return RelevanceEstimate(RelevanceMap((target != NO_TARGET).astype(np.float32), target))


class DetectingEstimator(RelevanceEstimator):
    """What the estimators with a detector share: the task's graph, the detector and the tracked objects."""

    def __init__(self, graph: TaskGraph, detector: Detector, settings: RelevanceTrackerSettings | None = None) -> None:
        self._graph = graph
        self._detector = detector
        matches = detector.matches(graph.queries)
        self._tracker = RelevanceTracker(graph, settings or RelevanceTrackerSettings(), matches)

    @property
    def notes(self) -> tuple[str, ...]:
        """Nouns that the detector cannot find, and anchors that no frame has shown yet."""
        return (*match_warnings(self._detector.matches(self._graph.queries)), *self._tracker.notes)

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """All objects detected so far for the task's nouns, in world coordinates."""
        return self._tracker.landmarks

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the task so far."""
        return self._tracker.objects

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """What the detector searches for each noun of the task, and what it has detected."""
        return tuple(self._tracker.report(match) for match in self._detector.matches(self._graph.queries))

    @property
    def known_objects(self) -> int:
        """The number of targets that were detected often enough so far."""
        return self._tracker.known_objects

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return an earlier frame's relevance with the objects that became known since."""
        return self._tracker.complete(frame, relevance)

    def point_at(self, noun: str, mask: Bool[ndarray, "h w"], frame: Frame) -> None:
        """Add the object that a person points at, by its mask on a frame. Raises InvalidInputError."""
        self._tracker.point_at(noun, mask, frame)

    def exclude(self, point_m: PointM) -> None:
        """Leave out the object at a point in the world. Raises InvalidInputError."""
        self._tracker.exclude(point_m)

    def state(self) -> State:
        """Return the tracker's state as named arrays, without running detections."""
        return self._tracker.state()

    def restore(self, state: State) -> None:
        """Replace the tracker's state by that of the same task. Raises MapFileError, InvalidInputError."""
        self._tracker.restore(state)


class TaskRelevanceEstimator(DetectingEstimator):
    """A RelevanceEstimator for a task graph that waits for its detector. Use from one thread at a time."""

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 1 on the pixels of the targets that satisfy the task's relations."""
        if not self._tracker.update_keyframe(frame):
            return RelevanceEstimate(self._tracker.propagate(frame))
        detections = self._detector.detect(frame, self._graph.queries)
        depth_m = best_depth_m(frame, rendered_depth_m)
        relevance = self._tracker.integrate(frame, depth_m, detections)
        return RelevanceEstimate(relevance, detected=DetectedImage.of(frame, detections))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """Return the relevance of an earlier frame after a detection on it."""
        return self._tracker.integrate(frame, frame.depth_m, self._detector.detect(frame, self._graph.queries))


class AsyncRelevanceEstimator(DetectingEstimator):
    """A RelevanceEstimator that does not wait: detections run on an executor of one thread.

    One detection runs at a time. Of the keyframes that arrive meanwhile, only the newest is queued. A finished
    detection is propagated to the current frame, and the keyframe's own relevance is returned as delayed.
    Evaluations of past frames use the same executor. Use from one thread at a time.
    """

    def __init__(
        self,
        graph: TaskGraph,
        detector: Detector,
        executor: Executor,
        settings: RelevanceTrackerSettings | None = None,
    ) -> None:
        super().__init__(graph, detector, settings)
        self._executor = executor
        self._frames = 0
        self._skipped_keyframes = 0
        self._running: tuple[_Keyframe, Future[list[Detection]]] | None = None
        self._queued: _Keyframe | None = None
        self._past_detection: tuple[FrameId, Future[list[Detection]]] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Nouns that the detector cannot find, anchors not seen yet, and the number of skipped keyframes."""
        count = self._skipped_keyframes
        skipped = (f"detector too slow: {count} keyframes were skipped",) if count else ()
        return (*super().notes, *skipped)

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 1 on the pixels of the targets detected so far. Raises the detector's exceptions."""
        delayed, detected = self._collect()
        if self._tracker.update_keyframe(frame):
            self._skipped_keyframes += self._queued is not None
            self._queued = _Keyframe(frame, best_depth_m(frame, rendered_depth_m), self._frames)
        if self._running is None and self._queued is not None:
            future = self._executor.submit(self._detector.detect, self._queued.frame, self._graph.queries)
            self._running, self._queued = (self._queued, future), None
        self._frames += 1
        return RelevanceEstimate(self._tracker.propagate(frame), delayed, detected)

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        """Return the relevance of an earlier frame once its detection has finished; the first call starts it.

        Raises the detector's exceptions once; the next call starts the detection again.
        """
        if self._past_detection is None or self._past_detection[0] != frame.id:
            self._past_detection = frame.id, self._executor.submit(self._detector.detect, frame, self._graph.queries)
        _, future = self._past_detection
        if not future.done():
            return None
        self._past_detection = None
        return self._tracker.integrate(frame, frame.depth_m, future.result())

    def _collect(self) -> tuple[DelayedRelevance | None, DetectedImage | None]:
        """Integrate the running detection if it has finished."""
        if self._running is None or not self._running[1].done():
            return None, None
        (keyframe, future), self._running = self._running, None
        detections = future.result()
        relevance = self._tracker.integrate(keyframe.frame, keyframe.depth_m, detections)
        delayed = DelayedRelevance(keyframe.frame.id, relevance, self._frames - keyframe.number)
        return delayed, DetectedImage.of(keyframe.frame, detections)


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A frame to detect on, the depth that lifts its detections, and its number among all frames."""

    frame: Frame
    depth_m: Float32[ndarray, "h w"]
    number: int
