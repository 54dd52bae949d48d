"""Accuracy of perception's masks against ground truth after each stage: detection, relations, evidence, tracking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.pose import UpAxis
from gausslite.domain.relevance import MIN_ROI_PIXELS, Detection, Region, RelevanceMap
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.detector import Detector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.relevance_tracker import merge_masks
from gausslite.perception.settings import EvidenceSettings, RelevanceTrackerSettings

_MIN_FOUND_SHARE = 0.25
_CONFIRM_ALL = EvidenceSettings(1, 0.0, 0.0, np.inf, 0.0)


class PerceptionStage(StrEnum):
    """Stages of perception; each includes the previous ones.

    detected: the detector's masks. related: objects whose masks are limited to the foreground in depth, merged with the
    object's measured surface and filtered by the task's relations. confirmed: objects with sufficient evidence. These
    three run the detector on every frame. tracked: as in a mission, with detection on keyframes only. completed: the
    same, and the frames before an object was known get its mask when it becomes known.
    """

    DETECTED = "detected"
    RELATED = "related"
    CONFIRMED = "confirmed"
    TRACKED = "tracked"
    COMPLETED = "completed"


@dataclass(frozen=True, slots=True)
class TaskQuery:
    """A task and the ground-truth objects of its target; no objects if the target is absent."""

    graph: TaskGraph
    objects: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StageScore:
    """Scores of one stage over all frames.

    iou, precision and recall are computed over the pixels with depth of all frames, where ground truth is known; None
    if the target is absent or no pixel is marked. marked_*: marked share of an image, over all pixels. right_frames:
    marked frames with more than half of the marked pixels on the task's objects. objects_found: objects with a
    quarter of their pixels marked in some frame. late_frames: mean delay from the first frame that shows an object to
    the first that marks it.
    """

    iou: float | None
    precision: float | None
    recall: float | None
    marked_mean: float
    marked_max: float
    marked_frames: int
    right_frames: int
    objects_found: int
    late_frames: float | None


@dataclass(frozen=True, slots=True)
class TaskScore:
    """Scores of one task over all frames. shown_frames show at least MIN_ROI_PIXELS of its objects."""

    task: str
    objects: tuple[str, ...]
    frames: int
    shown_frames: int
    shown_objects: int
    stages: Mapping[PerceptionStage, StageScore]


class PerceptionBench:
    """Runs every stage for every task on the frames, in order."""

    def __init__(
        self,
        detector: Detector,
        queries: Sequence[TaskQuery],
        regions: Mapping[str, Region],
        up_axis: UpAxis,
    ) -> None:
        """regions: ground truth by object name. Raises InvalidInputError for an object without region."""
        for query in queries:
            unknown = [name for name in query.objects if name not in regions]
            if unknown:
                known = ", ".join(sorted(regions)) or "none"
                raise InvalidInputError(f"objects: expected names among {known}; got {', '.join(unknown)}")
        nouns = dict.fromkeys(noun for query in queries for noun in query.graph.queries)
        detector = _SharedDetections(detector, tuple(nouns))
        self._regions = {name: regions[name] for query in queries for name in query.objects}
        self._evaluations = [_TaskEvaluation(query, detector, up_axis) for query in queries]

    def process(self, frame: Frame) -> None:
        """Run each task's stages on the next frame."""
        truths = {name: region.mask(frame) for name, region in self._regions.items()}
        for evaluation in self._evaluations:
            evaluation.process(frame, truths)

    def scores(self) -> list[TaskScore]:
        """Return the scores over the processed frames, one per task; to be called once, after the last frame."""
        return [evaluation.score() for evaluation in self._evaluations]


class _TaskEvaluation:
    """Estimators and counters of one task."""

    def __init__(self, query: TaskQuery, detector: Detector, up_axis: UpAxis) -> None:
        self._query, self._detector = query, detector
        every_frame = RelevanceTrackerSettings(up_axis=up_axis, max_frames=1)
        settings = {
            PerceptionStage.RELATED: replace(every_frame, evidence=_CONFIRM_ALL),
            PerceptionStage.CONFIRMED: every_frame,
            PerceptionStage.TRACKED: RelevanceTrackerSettings(up_axis=up_axis),
        }
        self._estimators = {
            stage: TaskRelevanceEstimator(query.graph, self._detector, tracker_settings)
            for stage, tracker_settings in settings.items()
        }
        self._past: list[tuple[Frame, RelevanceMap, Mapping[str, Bool[ndarray, "h w"]]]] = []
        self._first_shown: dict[str, int] = {}
        self._shown_frames = self._frames = 0
        self._counters = {stage: _StageCounter() for stage in PerceptionStage}

    def process(self, frame: Frame, truths: Mapping[str, Bool[ndarray, "h w"]]) -> None:
        graph = self._query.graph
        nouns = [noun_of(target) for target in graph.targets]
        every = self._detector.detect(frame, graph.queries)
        detections = [detection for detection in every if detection.phrase in nouns and not detection.is_weak]
        masks = {
            PerceptionStage.DETECTED: merge_masks(
                [(found.phrase, found.mask) for found in detections], nouns, frame
            ).roi
        }
        relevance = {stage: estimator.estimate(frame).relevance for stage, estimator in self._estimators.items()}
        masks |= {stage: stage_relevance.roi for stage, stage_relevance in relevance.items()}
        objects = {name: truths[name] & (frame.depth_m > 0) for name in self._query.objects}
        for name, pixels in objects.items():
            if np.count_nonzero(pixels) >= MIN_ROI_PIXELS:
                self._first_shown.setdefault(name, self._frames)
        self._shown_frames += bool(np.count_nonzero(_union(objects, frame)) >= MIN_ROI_PIXELS)
        for stage, mask in masks.items():
            self._counters[stage].add(self._frames, mask, frame, objects)
        # as the mapper completes its keyframes when an object becomes known
        tracked = self._estimators[PerceptionStage.TRACKED]
        self._past = [
            (past, mask if mask.known_objects >= tracked.known_objects else tracked.complete(past, mask), shown)
            for past, mask, shown in (*self._past, (frame, relevance[PerceptionStage.TRACKED], objects))
        ]
        self._frames += 1

    def score(self) -> TaskScore:
        # these masks are final after the last frame only
        for number, (frame, relevance, objects) in enumerate(self._past):
            self._counters[PerceptionStage.COMPLETED].add(number, relevance.roi, frame, objects)
        stages = {stage: counter.score(self._first_shown) for stage, counter in self._counters.items()}
        counts = self._frames, self._shown_frames, len(self._first_shown)
        return TaskScore(self._query.graph.text, self._query.objects, *counts, stages)


def _union(objects: Mapping[str, Bool[ndarray, "h w"]], frame: Frame) -> Bool[ndarray, "h w"]:
    union = np.zeros(frame.depth_m.shape, np.bool_)
    for pixels in objects.values():
        union |= pixels
    return union


class _StageCounter:
    """Pixel and frame counts of one stage."""

    def __init__(self) -> None:
        self._frames: list[tuple[float, ...]] = []
        self._first_found: dict[str, int] = {}

    def add(
        self, number: int, mask: Bool[ndarray, "h w"], frame: Frame, objects: Mapping[str, Bool[ndarray, "h w"]]
    ) -> None:
        truth = _union(objects, frame)
        counts = (int(np.count_nonzero(pixels)) for pixels in (mask & (frame.depth_m > 0), mask & truth, truth))
        self._frames.append((float(mask.mean()), *counts))
        for name, pixels in objects.items():
            size = np.count_nonzero(pixels)
            if size >= MIN_ROI_PIXELS and np.count_nonzero(mask & pixels) >= _MIN_FOUND_SHARE * size:
                self._first_found.setdefault(name, number)

    def score(self, first_shown: Mapping[str, int]) -> StageScore:
        shares, marked, correct, true = np.array(self._frames).reshape(-1, 4).T
        union = float((marked + true - correct).sum())
        delays = [first - first_shown[name] for name, first in self._first_found.items()]
        is_shown = bool(true.any())
        return StageScore(
            iou=float(correct.sum()) / union if is_shown else None,
            precision=float(correct.sum() / marked.sum()) if is_shown and marked.any() else None,
            recall=float(correct.sum() / true.sum()) if is_shown else None,
            marked_mean=float(shares.mean()) if len(shares) else 0.0,
            marked_max=float(shares.max(initial=0.0)),
            marked_frames=int(np.count_nonzero(shares)),
            right_frames=int(np.count_nonzero(2 * correct > marked)),
            objects_found=len(delays),
            late_frames=float(np.mean(delays)) if delays else None,
        )


class _SharedDetections:
    """Detects the nouns of all tasks at once, and keeps the result for the latest frame.

    Detectors treat each noun alone, so every task gets the detections that it would get without the others.
    """

    def __init__(self, detector: Detector, nouns: Sequence[str]) -> None:
        self._detector, self._nouns = detector, nouns
        self._latest: tuple[Frame, list[Detection]] | None = None

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return self._detector.matches(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        if self._latest is None or self._latest[0] is not frame:
            self._latest = frame, self._detector.detect(frame, self._nouns)
        return [detection for detection in self._latest[1] if detection.phrase in queries]
