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
from gausslite.domain.relevance import MIN_ROI_PIXELS, Detection, Region
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.perception.detector import Detector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.relevance_tracker import merge_detections
from gausslite.perception.settings import EvidenceSettings, RelevanceTrackerSettings
from gausslite_bench.perception.past_frames import PastFrames
from gausslite_bench.perception.shared_detections import SharedDetections

_MIN_FOUND_SHARE = 0.25


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


@dataclass(frozen=True, slots=True, eq=False)
class FrameMasks:
    """One frame and task: the detections, the mask of each stage but the last, and the ground-truth mask."""

    query: TaskQuery
    frame: Frame
    detections: Sequence[Detection]
    masks: Mapping[PerceptionStage, Bool[ndarray, "h w"]]
    truth: Bool[ndarray, "h w"]


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
class ObjectScore:
    """Scores of one object of a task.

    shown_frames: frames that show at least MIN_ROI_PIXELS of it. detected_share: share of them in which the detector
    marks a quarter of its pixels. recall: by stage, marked share of its pixels from its first detection on, or for the
    stage `completed` in all these frames; None if it is never detected.
    """

    name: str
    shown_frames: int
    detected_share: float
    recall: Mapping[PerceptionStage, float | None]


@dataclass(frozen=True, slots=True)
class TaskScore:
    """Scores of one task over all frames. shown_frames show at least MIN_ROI_PIXELS of its objects."""

    task: str
    objects: tuple[str, ...]
    frames: int
    shown_frames: int
    shown_objects: int
    stages: Mapping[PerceptionStage, StageScore]
    object_scores: tuple[ObjectScore, ...] = ()


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
        names = dict.fromkeys(name for query in queries for name in query.objects)
        detector = SharedDetections(
            detector, tuple(dict.fromkeys(noun for query in queries for noun in query.graph.queries))
        )
        self._regions = {name: regions[name] for name in names}
        self._evaluations = [_TaskEvaluation(query, detector, up_axis) for query in queries]

    def process(self, frame: Frame) -> list[FrameMasks]:
        """Return the masks of each task's stages in the next frame."""
        truths = {name: region.mask(frame) for name, region in self._regions.items()}
        return [evaluation.process(frame, truths) for evaluation in self._evaluations]

    def scores(self) -> list[TaskScore]:
        """Return the scores over the processed frames, one per task."""
        return [evaluation.score() for evaluation in self._evaluations]


class _TaskEvaluation:
    """Estimators and counters of one task."""

    def __init__(self, query: TaskQuery, detector: Detector, up_axis: UpAxis) -> None:
        self._query = query
        self._detector = _CachedDetector(detector)
        every_frame = RelevanceTrackerSettings(up_axis=up_axis, max_frames=1)
        settings = {
            PerceptionStage.RELATED: replace(every_frame, evidence=EvidenceSettings.accept_all()),
            PerceptionStage.CONFIRMED: every_frame,
            PerceptionStage.TRACKED: RelevanceTrackerSettings(up_axis=up_axis),
        }
        self._estimators = {
            stage: TaskRelevanceEstimator(query.graph, self._detector, tracker_settings)
            for stage, tracker_settings in settings.items()
        }
        self._past_frames = PastFrames(self._estimators[PerceptionStage.TRACKED])
        self._first_shown: dict[str, int] = {}
        self._shown_frames = self._frames = 0
        self._counters = {stage: _StageCounter() for stage in PerceptionStage}
        self._object_counters = {name: _ObjectCounter() for name in query.objects}

    def process(self, frame: Frame, truths: Mapping[str, Bool[ndarray, "h w"]]) -> FrameMasks:
        graph = self._query.graph
        nouns = [noun_of(target) for target in graph.targets]
        every = self._detector.detect(frame, graph.queries)
        detections = [detection for detection in every if detection.phrase in nouns and not detection.is_weak]
        masks = {PerceptionStage.DETECTED: merge_detections(detections, nouns, frame).roi}
        relevance = {stage: estimator.estimate(frame).relevance for stage, estimator in self._estimators.items()}
        masks |= {stage: stage_relevance.roi for stage, stage_relevance in relevance.items()}
        has_depth = frame.depth_m > 0
        objects = {name: truths[name] & has_depth for name in self._query.objects}
        truth = np.zeros(has_depth.shape, np.bool_)
        for name, pixels in objects.items():
            truth |= pixels
            if np.count_nonzero(pixels) >= MIN_ROI_PIXELS:
                self._first_shown.setdefault(name, self._frames)
        self._shown_frames += bool(np.count_nonzero(truth) >= MIN_ROI_PIXELS)
        for stage, mask in masks.items():
            self._counters[stage].add(self._frames, mask, has_depth, truth, objects)
        for name, pixels in objects.items():
            self._object_counters[name].add(masks, pixels)
        self._past_frames.add(frame, relevance[PerceptionStage.TRACKED], objects)
        self._frames += 1
        return FrameMasks(self._query, frame, detections, masks, truth)

    def score(self) -> TaskScore:
        """Return the scores; to be called once, after the last frame."""
        self._count_completed()
        stages = {stage: counter.score(self._frames, self._first_shown) for stage, counter in self._counters.items()}
        query = self._query
        counts = self._frames, self._shown_frames, len(self._first_shown)
        object_scores = tuple(counter.score(name) for name, counter in self._object_counters.items())
        return TaskScore(query.graph.text, query.objects, *counts, stages, object_scores)

    def _count_completed(self) -> None:
        """Count the masks of the stage `completed`, which are final after the last frame only."""
        stage = PerceptionStage.COMPLETED
        for number, (frame, mask, objects) in enumerate(self._past_frames.masks()):
            truth = np.logical_or.reduce([np.zeros(mask.shape, np.bool_), *objects.values()])
            self._counters[stage].add(number, mask, frame.depth_m > 0, truth, objects)
            for name, pixels in objects.items():
                self._object_counters[name].add_completed(mask, pixels)


class _ObjectCounter:
    """Counts of one object: its pixels from the first detection on, and those that each stage marks."""

    def __init__(self) -> None:
        self._shown_frames = self._detected_frames = self._pixels = self._shown_pixels = 0
        self._marked = dict.fromkeys(PerceptionStage, 0)

    def add(self, masks: Mapping[PerceptionStage, Bool[ndarray, "h w"]], pixels: Bool[ndarray, "h w"]) -> None:
        size = int(np.count_nonzero(pixels))
        if size < MIN_ROI_PIXELS:
            return
        marked = {stage: int(np.count_nonzero(mask & pixels)) for stage, mask in masks.items()}
        self._shown_frames += 1
        self._detected_frames += marked[PerceptionStage.DETECTED] >= _MIN_FOUND_SHARE * size
        if self._detected_frames > 0:
            self._pixels += size
            for stage, count in marked.items():
                self._marked[stage] += count

    def add_completed(self, mask: Bool[ndarray, "h w"], pixels: Bool[ndarray, "h w"]) -> None:
        size = int(np.count_nonzero(pixels))
        if size >= MIN_ROI_PIXELS:
            self._shown_pixels += size
            self._marked[PerceptionStage.COMPLETED] += int(np.count_nonzero(mask & pixels))

    def score(self, name: str) -> ObjectScore:
        detected_share = self._detected_frames / max(1, self._shown_frames)
        totals = dict.fromkeys(PerceptionStage, self._pixels) | {PerceptionStage.COMPLETED: self._shown_pixels}
        recall = {stage: self._marked[stage] / totals[stage] if self._pixels else None for stage in PerceptionStage}
        return ObjectScore(name, self._shown_frames, detected_share, recall)


class _StageCounter:
    """Pixel and frame counts of one stage."""

    def __init__(self) -> None:
        self._correct = self._marked = self._true = 0
        self._shares: list[float] = []
        self._right_frames = 0
        self._first_found: dict[str, int] = {}

    def add(
        self,
        frame_number: int,
        mask: Bool[ndarray, "h w"],
        has_depth: Bool[ndarray, "h w"],
        truth: Bool[ndarray, "h w"],
        objects: Mapping[str, Bool[ndarray, "h w"]],
    ) -> None:
        self._shares.append(float(mask.mean()))
        marked, correct = int(np.count_nonzero(mask & has_depth)), int(np.count_nonzero(mask & truth))
        self._marked += marked
        self._correct += correct
        self._true += int(np.count_nonzero(truth))
        self._right_frames += bool(2 * correct > marked)
        for name, pixels in objects.items():
            size = np.count_nonzero(pixels)
            if size >= MIN_ROI_PIXELS and np.count_nonzero(mask & pixels) >= _MIN_FOUND_SHARE * size:
                self._first_found.setdefault(name, frame_number)

    def score(self, frames: int, first_shown: Mapping[str, int]) -> StageScore:
        delays = [first - first_shown[name] for name, first in self._first_found.items()]
        union = self._marked + self._true - self._correct
        return StageScore(
            iou=self._correct / union if self._true else None,
            precision=self._correct / self._marked if self._true and self._marked else None,
            recall=self._correct / self._true if self._true else None,
            marked_mean=sum(self._shares) / max(1, frames),
            marked_max=max(self._shares, default=0.0),
            marked_frames=sum(share > 0 for share in self._shares),
            right_frames=self._right_frames,
            objects_found=len(delays),
            late_frames=sum(delays) / len(delays) if delays else None,
        )


class _CachedDetector:
    """A Detector that runs once per frame and returns the same detections to all stages."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._last: tuple[Frame, list[Detection]] | None = None

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return self._detector.matches(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        if self._last is None or self._last[0] is not frame:
            self._last = frame, self._detector.detect(frame, queries)
        return self._last[1]
