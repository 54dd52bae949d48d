"""Measure what perception marks against ground truth: as detected, as related in space, and as a mission follows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.domain.relevance import Detection
from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.evaluation.views import MIN_ROI_PIXELS
from gausslite.perception.detect import Detector, Segmenter
from gausslite.perception.evidence import EvidenceSettings
from gausslite.perception.relevance_estimator import TaskRelevanceEstimator
from gausslite.perception.tracker import TrackerSettings, merge_detections

_FOUND_SHARE = 0.25


class PerceptionStage(StrEnum):
    """How far perception has come.

    detected: the detector's own masks. related: cut to the object's layer of depth and judged by the task's relations.
    believed: and by the evidence for each object; up to here the detector sees every frame, and a frame shows what it
    found there. followed: as a mission does it, detecting on keyframes alone and carrying targets on.
    """

    DETECTED = "detected"
    RELATED = "related"
    BELIEVED = "believed"
    FOLLOWED = "followed"


@dataclass(frozen=True, slots=True)
class Question:
    """A task, and the ground-truth objects it is about: none of them where its target is absent."""

    graph: TaskGraph
    objects: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """One frame under one question: what the detector found, the pixels each step marks, and the truth."""

    question: Question
    frame: Frame
    found: Sequence[Detection]
    masks: Mapping[PerceptionStage, Bool[ndarray, "h w"]]
    truth: Bool[ndarray, "h w"]


@dataclass(frozen=True, slots=True)
class StepScore:
    """One step over all frames.

    iou, precision and recall pool the pixels with depth, on which the truth is known; None where nothing is there to
    be found, or nothing was marked. marked_* are shares of an image, over all its pixels. right_frames are those of
    marked_frames whose marks lie on the asked objects by more than half. An object is found in the first frame that
    marks a quarter of it, late_frames after the first that shows it (mean over those found).
    """

    iou: float | None
    precision: float | None
    recall: float | None
    marked_mean: float
    marked_most: float
    marked_frames: int
    right_frames: int
    objects_found: int
    late_frames: float | None


@dataclass(frozen=True, slots=True)
class QuestionScore:
    """A question over all frames; shown_frames show MIN_ROI_PIXELS or more of its objects."""

    task: str
    objects: tuple[str, ...]
    frames: int
    shown_frames: int
    shown_objects: int
    steps: Mapping[PerceptionStage, StepScore]


class PerceptionBench:
    """Asks every question of every frame, in the frames' order."""

    def __init__(
        self,
        detector: Detector,
        questions: Sequence[Question],
        regions: Mapping[str, Region],
        up_axis: UpAxis,
        segmenter: Segmenter | None = None,
    ) -> None:
        """The regions go by object name. Raises InvalidInputError for a question about an object that has none."""
        for question in questions:
            unknown = [name for name in question.objects if name not in regions]
            if unknown:
                known = ", ".join(sorted(regions)) or "none"
                raise InvalidInputError(f"objects: expected names among {known}; got {', '.join(unknown)}")
        names = dict.fromkeys(name for question in questions for name in question.objects)
        self._regions = {name: regions[name] for name in names}
        self._asked = [_Asked(question, detector, up_axis, segmenter) for question in questions]

    def look(self, frame: Frame) -> list[Marks]:
        """What each question's steps mark in the next frame."""
        truths = {name: region.mask(frame) for name, region in self._regions.items()}
        return [asked.look(frame, truths) for asked in self._asked]

    def scores(self) -> list[QuestionScore]:
        """The figures over the frames so far, one entry a question."""
        return [asked.score() for asked in self._asked]


class _Asked:
    """One question's attentions and tallies."""

    def __init__(self, question: Question, detector: Detector, up_axis: UpAxis, segmenter: Segmenter | None) -> None:
        self._question = question
        self._detector = _OnceAFrame(detector)
        alone = TrackerSettings(up_axis=up_axis, max_frames=1, max_missed_detections=0)
        settings = {
            PerceptionStage.RELATED: replace(alone, evidence=EvidenceSettings.accept_all()),
            PerceptionStage.BELIEVED: alone,
            PerceptionStage.FOLLOWED: TrackerSettings(up_axis=up_axis),
        }
        self._attentions = {
            step: TaskRelevanceEstimator(question.graph, self._detector, chosen, segmenter)
            for step, chosen in settings.items()
        }
        self._first_shown: dict[str, int] = {}
        self._shown_frames = self._frames = 0
        self._tallies = {step: _Tally() for step in PerceptionStage}

    def look(self, frame: Frame, truths: Mapping[str, Bool[ndarray, "h w"]]) -> Marks:
        graph = self._question.graph
        found = [each for each in self._detector.detect(frame, graph.queries) if each.phrase in graph.targets]
        masks = {PerceptionStage.DETECTED: merge_detections(found, graph.targets, frame).roi}
        masks |= {step: attention.estimate(frame).relevance.roi for step, attention in self._attentions.items()}
        known = frame.depth_m > 0
        objects = {name: truths[name] & known for name in self._question.objects}
        truth = np.zeros(known.shape, np.bool_)
        for name, pixels in objects.items():
            truth |= pixels
            if np.count_nonzero(pixels) >= MIN_ROI_PIXELS:
                self._first_shown.setdefault(name, self._frames)
        self._shown_frames += bool(np.count_nonzero(truth) >= MIN_ROI_PIXELS)
        for step, mask in masks.items():
            self._tallies[step].add(self._frames, mask, known, truth, objects)
        self._frames += 1
        return Marks(self._question, frame, found, masks, truth)

    def score(self) -> QuestionScore:
        steps = {step: tally.score(self._frames, self._first_shown) for step, tally in self._tallies.items()}
        question = self._question
        return QuestionScore(
            question.graph.text, question.objects, self._frames, self._shown_frames, len(self._first_shown), steps
        )


class _Tally:
    """Counts one step's pixels."""

    def __init__(self) -> None:
        self._shared = self._marked = self._true = 0
        self._shares: list[float] = []
        self._right_frames = 0
        self._first_found: dict[str, int] = {}

    def add(
        self,
        number: int,
        mask: Bool[ndarray, "h w"],
        known: Bool[ndarray, "h w"],
        truth: Bool[ndarray, "h w"],
        objects: Mapping[str, Bool[ndarray, "h w"]],
    ) -> None:
        self._shares.append(float(mask.mean()))
        marked, shared = int(np.count_nonzero(mask & known)), int(np.count_nonzero(mask & truth))
        self._marked += marked
        self._shared += shared
        self._true += int(np.count_nonzero(truth))
        self._right_frames += bool(2 * shared > marked)
        for name, pixels in objects.items():
            size = np.count_nonzero(pixels)
            if size >= MIN_ROI_PIXELS and np.count_nonzero(mask & pixels) >= _FOUND_SHARE * size:
                self._first_found.setdefault(name, number)

    def score(self, frames: int, first_shown: Mapping[str, int]) -> StepScore:
        late = [first - first_shown[name] for name, first in self._first_found.items()]
        union = self._marked + self._true - self._shared
        return StepScore(
            iou=self._shared / union if self._true else None,
            precision=self._shared / self._marked if self._true and self._marked else None,
            recall=self._shared / self._true if self._true else None,
            marked_mean=sum(self._shares) / max(1, frames),
            marked_most=max(self._shares, default=0.0),
            marked_frames=sum(share > 0 for share in self._shares),
            right_frames=self._right_frames,
            objects_found=len(late),
            late_frames=sum(late) / len(late) if late else None,
        )


class _OnceAFrame:
    """A Detector that gives all steps of a question one answer about a frame."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._answered: tuple[Frame, list[Detection]] | None = None

    def unsupported(self, queries: Sequence[str]) -> tuple[str, ...]:
        return self._detector.unsupported(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        if self._answered is None or self._answered[0] is not frame:
            self._answered = frame, self._detector.detect(frame, queries)
        return self._answered[1]
