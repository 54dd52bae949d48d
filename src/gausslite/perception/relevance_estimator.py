"""The task's attention (Sec. III-B): detect on keyframes, carry over between them, filter in 3D, merge to w(u, v)."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection, RelevanceMap
from gausslite.domain.state import State
from gausslite.domain.task import TaskGraph
from gausslite.perception.detect import Detector, Segmenter
from gausslite.perception.object_map import Landmark
from gausslite.perception.spatial import best_depth_m
from gausslite.perception.tracker import TargetTracker, TrackerSettings


@dataclass(frozen=True, slots=True, eq=False)
class DelayedRelevance:
    """The relevance of a frame that was attended to lag_frames frames ago, when it was not known yet."""

    frame: Frame
    relevance: RelevanceMap
    lag_frames: int


@dataclass(frozen=True, slots=True, eq=False)
class RelevanceEstimate:
    """The relevance of a frame, and that of an earlier frame if its detection has finished since the last call."""

    relevance: RelevanceMap
    delayed: DelayedRelevance | None = None


@runtime_checkable
class RelevanceEstimator(Protocol):
    """Says for each frame which pixels the task is about."""

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return the relevance of one frame. rendered_depth_m is rendered from the current map, 0 where it is empty."""
        ...

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        """The relevance of an earlier frame, attended to for another task; None where it is not known yet: ask again.

        Asked from the newest such frame to the oldest, one at a time.
        """
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What the operator should know of the frames so far, one line each."""
        ...

    def state(self) -> State:
        """What the next frame's relevance depends on besides that frame."""
        ...

    def restore(self, state: State) -> None:
        """Go on from what an attention to the same task handed out. Raises MapFileError."""
        ...


class TaskRelevanceEstimator:
    """An RelevanceEstimator that follows a task graph and waits for its detector. One thread at a time."""

    def __init__(
        self,
        graph: TaskGraph,
        detector: Detector,
        settings: TrackerSettings | None = None,
        segmenter: Segmenter | None = None,
    ) -> None:
        """Without a segmenter, carried boxes are cut out by depth alone."""
        self._graph = graph
        self._detector = detector
        self._tracker = TargetTracker(graph, settings or TrackerSettings(), segmenter)

    @property
    def notes(self) -> tuple[str, ...]:
        """Nouns without a class, and anchors that have not come into view."""
        return (*self._detector.unsupported(self._graph.queries), *self._tracker.notes)

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The objects that the task's nouns have named so far, where they were seen."""
        return self._tracker.landmarks

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Weight 1 on the pixels of the targets that fit the task's relations."""
        if not self._tracker.update_keyframe(frame):
            return RelevanceEstimate(self._tracker.propagate(frame))
        found = self._detector.detect(frame, self._graph.queries)
        return RelevanceEstimate(self._tracker.integrate(frame, best_depth_m(frame.depth_m, rendered_depth_m), found))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """Detect on an earlier frame."""
        return self._tracker.evaluate_past(frame, self._detector.detect(frame, self._graph.queries))

    def state(self) -> State:
        """The objects and targets that are followed."""
        return self._tracker.state()

    def restore(self, state: State) -> None:
        """Follow on what another attention to this task followed. Raises MapFileError, InvalidInputError."""
        self._tracker.restore(state)


class AsyncRelevanceEstimator:
    """Estimate relevance for a task graph without waiting: detections run on an executor of one thread.

    One detection runs at a time; of the keyframes that come meanwhile the newest waits and replaces an older one. What
    was found on a keyframe is taken when it is there and carried over to the frame at hand; the keyframe's own
    relevance comes late. A look back at an earlier frame takes turns with them. One thread at a time calls it.
    """

    def __init__(
        self,
        graph: TaskGraph,
        detector: Detector,
        executor: Executor,
        settings: TrackerSettings | None = None,
        segmenter: Segmenter | None = None,
    ) -> None:
        """Without a segmenter, carried boxes are cut out by depth alone."""
        self._graph = graph
        self._detector = detector
        self._executor = executor
        self._tracker = TargetTracker(graph, settings or TrackerSettings(), segmenter)
        self._frames = 0
        self._skipped_keyframes = 0
        self._running: tuple[_Keyframe, Future[list[Detection]]] | None = None
        self._waiting: _Keyframe | None = None
        self._past_detection: tuple[Frame, Future[list[Detection]]] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Nouns without a class, anchors that have not come into view, keyframes that were never looked at."""
        overtaken = (f"detector too slow: {self._skipped_keyframes} keyframes were overtaken",) if self._skipped_keyframes else ()
        return (*self._detector.unsupported(self._graph.queries), *self._tracker.notes, *overtaken)

    def state(self) -> State:
        """The objects and targets that are followed; what the detector is busy with is not among them."""
        return self._tracker.state()

    def restore(self, state: State) -> None:
        """Follow on what another attention to this task followed. Raises MapFileError, InvalidInputError."""
        self._tracker.restore(state)

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Weight 1 on the pixels of the targets known so far. Raises what the detector raised."""
        delayed = self._collect()
        if self._tracker.update_keyframe(frame):
            self._skipped_keyframes += self._waiting is not None
            self._waiting = _Keyframe(frame, best_depth_m(frame.depth_m, rendered_depth_m), self._frames)
        if self._running is None and self._waiting is not None:
            found = self._executor.submit(self._detector.detect, self._waiting.frame, self._graph.queries)
            self._running, self._waiting = (self._waiting, found), None
        self._frames += 1
        return RelevanceEstimate(self._tracker.propagate(frame), delayed)

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        """What was found on an earlier frame; the first call has it looked at.

        Raises what the detector raised, once: who asks again has it looked at again.
        """
        if self._past_detection is None or self._past_detection[0] is not frame:
            self._past_detection = frame, self._executor.submit(self._detector.detect, frame, self._graph.queries)
        _, found = self._past_detection
        if not found.done():
            return None
        self._past_detection = None
        return self._tracker.evaluate_past(frame, found.result())

    def _collect(self) -> DelayedRelevance | None:
        """Take what was found, if the detector is done."""
        if self._running is None or not self._running[1].done():
            return None
        (key, found), self._running = self._running, None
        relevance = self._tracker.integrate(key.frame, key.depth_m, found.result())
        return DelayedRelevance(key.frame, relevance, self._frames - key.number)


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A frame to detect on, the depth its detections are lifted by, and its number among all frames."""

    frame: Frame
    depth_m: Float32[ndarray, "h w"]
    number: int
