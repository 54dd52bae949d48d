"""Detect nouns with a network of fixed classes, and segment boxes with the masks of any class."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import CompetingClass, DetectedBox, Detection
from gausslite.nouns import is_generic, same_kind
from gausslite_detectors.boxes import BoxSizeLimits, box_iou, with_unseen
from gausslite_detectors.class_match import ClassMatchSettings, TextEmbeddings, class_nouns, match_noun
from gausslite_detectors.class_names import names_file
from gausslite_detectors.model_file import OpenModel
from gausslite_detectors.network import Candidates, DetectionNetwork, suppress


@dataclass(frozen=True, slots=True)
class ClassAgnosticSettings:
    """Which masks of an image are candidates, and which candidate a box gets.

    min_score: lowest score of a candidate. nms_max_iou: IoU of two boxes above which non-maximum suppression drops the
    lower score. max_masks: number of candidates. min_box_iou: lowest IoU of the given box with its mask's box.
    """

    min_score: float = 0.4
    nms_max_iou: float = 0.9
    min_box_iou: float = 0.5
    max_masks: int = 100

    def __post_init__(self) -> None:
        for name in ("min_score", "nms_max_iou", "min_box_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"segmenter {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_masks <= 1000:
            raise InvalidInputError(f"segmenter max_masks: expected 1 to 1000, got {self.max_masks}")

    @classmethod
    def for_classes(cls, classes: int) -> ClassAgnosticSettings:
        """Return settings for a network; with many classes, each score is lower than FastSAM's with its one class."""
        return cls() if classes == 1 else cls(min_score=0.03, nms_max_iou=0.7)


class ClassAgnosticSegmenter:
    """A Segmenter that gives each box the mask of the instance, of any class, with the largest overlap."""

    def __init__(self, network: DetectionNetwork, settings: ClassAgnosticSettings | None = None) -> None:
        """Without settings, use the defaults for the network's number of classes."""
        self._network = network
        self._settings = settings or ClassAgnosticSettings.for_classes(network.layout.classes)

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """Return per box the mask with the largest box IoU; None if no IoU reaches min_box_iou."""
        if len(boxes_px) == 0:
            return []
        output = self._network.run(frame)
        candidates = output.candidates(self._settings.min_score)
        candidates = suppress(candidates, self._settings.nms_max_iou, self._settings.max_masks, across_classes=True)
        if len(candidates.scores) == 0:
            return [None] * len(boxes_px)
        overlaps = box_iou(boxes_px, candidates.boxes_px)
        is_match = overlaps.max(axis=1) >= self._settings.min_box_iou
        masks = output.masks(candidates.take(overlaps.argmax(axis=1)))
        return [mask if match and mask.any() else None for mask, match in zip(masks, is_match, strict=True)]


@dataclass(frozen=True, slots=True)
class ClassDetectorSettings:
    """Thresholds of score, overlap and size of the boxes.

    weak_score: lowest score of weak detections, which only named objects have. rival_min_iou: lowest
    overlap of a box with one of a different class that may show the same object: a monitor is detected as `tv` with
    0.7 and, in the same box, as `laptop` with 0.3. class_match: which class a noun is searched as.
    """

    min_score: float = 0.25
    weak_score: float = 0.1
    nms_max_iou: float = 0.7
    max_boxes: int = 100
    rival_min_iou: float = 0.6
    class_match: ClassMatchSettings = field(default_factory=ClassMatchSettings)
    box_limits: BoxSizeLimits = field(default_factory=BoxSizeLimits)

    def __post_init__(self) -> None:
        for name in ("min_score", "weak_score", "nms_max_iou", "rival_min_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")


class ClassDetector:
    """A BoxDetector for one file with class names; with masks also a Detector."""

    def __init__(
        self, model: OpenModel, embeddings: TextEmbeddings | None = None, settings: ClassDetectorSettings | None = None
    ) -> None:
        """Run the model once to check its outputs. Raises ModelFileError.

        Without embeddings, nouns match classes only by name and by a short list of synonyms.
        """
        self._settings = settings or ClassDetectorSettings()
        self._embeddings = embeddings
        self._network = DetectionNetwork(model)
        if not self._network.layout.names:
            raise ModelFileError(
                f"model {model.path}: expected class names in the metadata field 'names' or, one per line, in "
                f"{names_file(model.path).name} beside it, got none"
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names of the network's classes, "" for an index without one."""
        return self._network.layout.names

    @property
    def has_masks(self) -> bool:
        """True if the network has masks; without them `detect` finds nothing, and `boxes` everything."""
        return self._network.layout.has_masks

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return the network's classes that match each query."""
        how = self._settings.class_match
        found = (match_noun(query, self.class_names, self._embeddings, how) for query in queries)
        return tuple(replace(match, min_score=self._settings.min_score) for match in found)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return all instances of each query with masks, best first, without boxes too large for their class."""
        query_classes = self._query_classes(queries)
        if not query_classes:
            return []
        output = self._network.run(frame)
        every = output.candidates(self._settings.weak_score)
        candidates = self._distinct(every, query_classes)
        masks, overlaps = output.masks(candidates), self._overlaps(candidates, every)
        found = [
            Detection(box.phrase, box.score, box.box_px, masks[row], box.rival, box.is_weak, class_name=box.class_name)
            for row, box in self._boxes(candidates, every, overlaps, query_classes, frame)
            if masks[row].any()
        ]
        return with_unseen(found, self.best_boxes(frame, queries), frame)

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the boxes of `detect` without masks."""
        query_classes = self._query_classes(queries)
        if not query_classes:
            return []
        every = self._network.run(frame).candidates(self._settings.weak_score)
        candidates = self._distinct(every, query_classes)
        overlaps = self._overlaps(candidates, every)
        return [box for _, box in self._boxes(candidates, every, overlaps, query_classes, frame)]

    def best_boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the box of each query with the best score, below every threshold and of any size too."""
        output, found = self._network.run(frame), []
        for query, classes in self._query_classes(queries).items():
            peak = output.peak(classes)
            left, top, right, bottom = (float(edge) for edge in peak.boxes_px[0])
            found.append(DetectedBox(query, float(peak.scores[0]), (left, top, right, bottom), is_weak=True))
        return found

    def _query_classes(self, queries: Sequence[str]) -> dict[str, tuple[int, ...]]:
        """Return the class indices of each query that is searched."""
        found = {match.noun: match.classes for match in self.matches(queries) if match.is_searched}
        return {
            query: tuple(index for index, name in enumerate(self.class_names) if name in names)
            for query, names in found.items()
        }

    def _overlaps(self, candidates: Candidates, every: Candidates) -> Bool[ndarray, "n m"]:
        """Return which candidates of all classes have nearly the same box as one of the queries' candidates."""
        overlaps: Bool[ndarray, "n m"] = box_iou(candidates.boxes_px, every.boxes_px) >= self._settings.rival_min_iou
        return overlaps

    def _boxes(
        self,
        candidates: Candidates,
        every: Candidates,
        overlaps: Bool[ndarray, "n m"],
        query_classes: Mapping[str, tuple[int, ...]],
        frame: Frame,
    ) -> Iterator[tuple[int, DetectedBox]]:
        """Yield row and box of each query's candidates, without boxes too large for their class.

        every: the candidates of all classes. overlaps: which of them show the same object as a candidate.
        """
        for query, classes in query_classes.items():
            for row in np.flatnonzero(np.isin(candidates.classes, classes)):
                name = self.class_names[candidates.classes[row]]
                left, top, right, bottom = (float(edge) for edge in candidates.boxes_px[row])
                rival = self._rival(query, classes, every.take(np.flatnonzero(overlaps[row])))
                score = float(candidates.scores[row])
                is_weak = score < self._settings.min_score
                if is_weak and is_generic(query):
                    continue
                box = DetectedBox(query, score, (left, top, right, bottom), rival, is_weak, class_nouns(name)[0])
                if self._settings.box_limits.accepts(box.class_name, box.score, box.box_px, frame):
                    yield int(row), box

    def _distinct(self, candidates: Candidates, query_classes: Mapping[str, tuple[int, ...]]) -> Candidates:
        """Return the candidates of the queries' classes after non-maximum suppression.

        Those that only a generic query means have a limit of their own: a named thing is found whatever is around it.
        """
        named, every = (
            sorted({index for query, own in query_classes.items() if of_all or not is_generic(query) for index in own})
            for of_all in (False, True)
        )
        is_named = np.isin(candidates.classes, named)
        is_other = np.isin(candidates.classes, every) & ~is_named & (candidates.scores >= self._settings.min_score)
        first, second = (self._limited(candidates.take(np.flatnonzero(own))) for own in (is_named, is_other))
        return first.joined(second)

    def _limited(self, candidates: Candidates) -> Candidates:
        """Return the best candidates without doubles of one class."""
        if self._network.layout.is_final:
            return candidates.take(np.argsort(-candidates.scores, kind="stable")[: self._settings.max_boxes])
        return suppress(candidates, self._settings.nms_max_iou, self._settings.max_boxes, across_classes=False)

    def _rival(self, query: str, classes: tuple[int, ...], overlapping: Candidates) -> CompetingClass | None:
        """Return the best overlapping detection of a different thing; None without one, and for generic nouns."""
        for row in np.argsort(-overlapping.scores, kind="stable"):
            index = int(overlapping.classes[row])
            name = self.class_names[index]
            is_other = not any(same_kind(query, noun) for noun in class_nouns(name))
            if index not in classes and not is_generic(query) and is_other:
                return CompetingClass(name, float(overlapping.scores[row]))
        return None


def load_class_detector(
    model: OpenModel, accept_similar: bool = False, min_score: float | None = None
) -> ClassDetector:
    """Return the detector with the text embeddings of the model's folder. Raises ModelFileError."""
    settings = ClassDetectorSettings(class_match=ClassMatchSettings(accept_similar=accept_similar))
    if min_score is not None:
        weak_score = min_score * settings.weak_score / settings.min_score
        settings = replace(settings, min_score=min_score, weak_score=weak_score)
    return ClassDetector(model, TextEmbeddings.from_model_folder(model.path), settings)
