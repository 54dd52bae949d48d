"""Detect nouns with a YOLO-seg network in an ONNX file: boxes and masks of a fixed set of classes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection
from gausslite.perception.box_size import BoxSizeLimits
from gausslite.perception.class_agnostic import ClassAgnosticSegmenter
from gausslite.perception.detect import DetectedBox
from gausslite.perception.models.model_file import OpenModel
from gausslite.perception.text_embeddings import TextEmbeddings, classes_for
from gausslite.perception.yolo_decode import Candidates, suppress
from gausslite.perception.yolo_network import YoloSegNetwork


@dataclass(frozen=True, slots=True)
class YoloSettings:
    """Thresholds of score, overlap and size of the boxes."""

    min_score: float = 0.25
    nms_max_iou: float = 0.7
    max_boxes: int = 100
    box_limits: BoxSizeLimits = field(default_factory=BoxSizeLimits)

    def __post_init__(self) -> None:
        for name in ("min_score", "nms_max_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")


class YoloSegDetector:
    """A Detector and BoxDetector for one YOLO-seg file with class names in its metadata."""

    def __init__(
        self, model: OpenModel, embeddings: TextEmbeddings | None = None, settings: YoloSettings | None = None
    ) -> None:
        """Run the model once to check its outputs. Raises ModelFileError.

        Without embeddings, nouns match classes only by name and by a short list of synonyms.
        """
        self._settings = settings or YoloSettings()
        self._embeddings = embeddings
        self._network = YoloSegNetwork(model)
        if not self._network.names:
            raise ModelFileError(f"model {model.path}: expected class names in the metadata field 'names', got none")

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names of the network's classes."""
        return self._network.names

    def unsupported(self, queries: Sequence[str]) -> tuple[str, ...]:
        """Return one message for each query that matches no class of the network."""
        return tuple(f"no class of the detector matches {query!r}" for query in queries if not self._classes(query))

    def segmenter(self) -> ClassAgnosticSegmenter:
        """Return a Segmenter over the same network, which uses masks of all classes."""
        return ClassAgnosticSegmenter(self._network)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return all instances of each query with masks, best first, without boxes too large for their class."""
        query_classes = self._query_classes(queries)
        if not query_classes:
            return []
        output = self._network.run(frame)
        candidates = self._distinct(output.candidates(self._settings.min_score), query_classes)
        masks = output.masks(candidates)
        return [
            Detection(box.phrase, box.score, box.box_px, masks[row])
            for row, box in self._matches(candidates, query_classes, frame)
            if masks[row].any()
        ]

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the boxes of `detect` without masks."""
        query_classes = self._query_classes(queries)
        if not query_classes:
            return []
        candidates = self._distinct(self._network.run(frame).candidates(self._settings.min_score), query_classes)
        return [box for _, box in self._matches(candidates, query_classes, frame)]

    def _query_classes(self, queries: Sequence[str]) -> dict[str, tuple[int, ...]]:
        """Return the class indices of each query that matches any class."""
        return {query: classes for query in queries if (classes := self._classes(query))}

    def _matches(
        self, candidates: Candidates, query_classes: Mapping[str, tuple[int, ...]], frame: Frame
    ) -> Iterator[tuple[int, DetectedBox]]:
        """Yield row and box of each query's candidates, without boxes too large for their class."""
        for query, classes in query_classes.items():
            for row in np.flatnonzero(np.isin(candidates.classes, classes)):
                name = self.class_names[candidates.classes[row]]
                left, top, right, bottom = (float(edge) for edge in candidates.boxes_px[row])
                box = DetectedBox(query, float(candidates.scores[row]), (left, top, right, bottom))
                if self._settings.box_limits.accepts(name, box.score, box.box_px, frame):
                    yield int(row), box

    def _distinct(self, candidates: Candidates, query_classes: Mapping[str, tuple[int, ...]]) -> Candidates:
        """Return the candidates of the queries' classes after non-maximum suppression."""
        classes = np.unique([index for indices in query_classes.values() for index in indices]).astype(np.int64)
        candidates = candidates.take(np.flatnonzero(np.isin(candidates.classes, classes)))
        return suppress(candidates, self._settings.nms_max_iou, self._settings.max_boxes, across_classes=False)

    def _classes(self, query: str) -> tuple[int, ...]:
        return classes_for(query, self.class_names, self._embeddings)


def load_yolo(model: OpenModel) -> YoloSegDetector:
    """Return the detector with the text embeddings of the model's folder. Raises ModelFileError."""
    return YoloSegDetector(model, TextEmbeddings.from_model_folder(model.path))
