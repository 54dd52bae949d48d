"""A YOLO-seg network in an ONNX file of the user's: boxes and masks of a fixed set of classes, asked for by nouns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection
from gausslite.errors import InvalidInputError, ModelFileError
from gausslite.perception.class_agnostic import ClassAgnosticSegmenter
from gausslite.perception.detect import BoxFractions, DetectedBox, concerns_many_objects
from gausslite.perception.model_file import OpenModel
from gausslite.perception.text_embeddings import TextEmbeddings, classes_for
from gausslite.perception.yolo_decode import Candidates, suppress
from gausslite.perception.yolo_network import YoloSegNetwork


@dataclass(frozen=True, slots=True)
class YoloSettings:
    """How sure and how distinct a box must be."""

    min_score: float = 0.25
    max_iou: float = 0.7
    max_boxes: int = 100
    box_fractions: BoxFractions = field(default_factory=BoxFractions)

    def __post_init__(self) -> None:
        for name in ("min_score", "max_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")


class YoloSegDetector:
    """A Detector, and a BoxDetector, over one YOLO-seg file whose metadata names its classes."""

    def __init__(
        self, model: OpenModel, vectors: TextEmbeddings | None = None, settings: YoloSettings | None = None
    ) -> None:
        """Try the model once, so that a wrong file is refused here. Raises ModelFileError.

        Without vectors, nouns find their classes by name and by a short list of synonyms alone.
        """
        self._settings = settings or YoloSettings()
        self._vectors = vectors
        self._network = YoloSegNetwork(model)
        if not self._network.names:
            raise ModelFileError(f"model {model.path}: expected class names in the metadata field 'names', got none")

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that the network knows."""
        return self._network.names

    def unsupported(self, queries: Sequence[str]) -> tuple[str, ...]:
        """Return one message for each query that matches no class of the network."""
        return tuple(f"no class of the detector matches {query!r}" for query in queries if not self._classes(query))

    def segmenter(self) -> ClassAgnosticSegmenter:
        """A Segmenter over the same network: all it sees in an image, of whatever class."""
        return ClassAgnosticSegmenter(self._network)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """All instances of each query with their masks, best first; boxes that span too much are left out."""
        wanted = self._wanted(queries)
        if not wanted:
            return []
        output = self._network.run(frame)
        found = self._distinct(output.candidates(self._settings.min_score), wanted)
        masks = output.masks(found)
        return [
            Detection(box.phrase, box.score, box.box_px, masks[row])
            for row, box in self._answers(found, wanted, concerns_many_objects(queries), frame.depth_m.size)
            if masks[row].any()
        ]

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """As `detect`, for others to cut out."""
        wanted = self._wanted(queries)
        if not wanted:
            return []
        found = self._distinct(self._network.run(frame).candidates(self._settings.min_score), wanted)
        answers = self._answers(found, wanted, concerns_many_objects(queries), frame.depth_m.size)
        return [box for _, box in answers]

    def _wanted(self, queries: Sequence[str]) -> dict[str, tuple[int, ...]]:
        """The classes of each query that has any."""
        return {query: classes for query in queries if (classes := self._classes(query))}

    def _answers(
        self, found: Candidates, wanted: Mapping[str, tuple[int, ...]], many: bool, pixels: int
    ) -> Iterator[tuple[int, DetectedBox]]:
        """The candidates that answer each query, with their rows; those that span too much are left out."""
        shares = (found.boxes_px[:, 2:] - found.boxes_px[:, :2]).prod(axis=1) / pixels
        for query, indices in wanted.items():
            for row in np.flatnonzero(np.isin(found.classes, indices)):
                if shares[row] <= self._settings.box_fractions.limit(self.class_names[found.classes[row]], many):
                    left, top, right, bottom = (float(edge) for edge in found.boxes_px[row])
                    yield int(row), DetectedBox(query, float(found.scores[row]), (left, top, right, bottom))

    def _distinct(self, found: Candidates, wanted: Mapping[str, tuple[int, ...]]) -> Candidates:
        """The candidates of the wanted classes, one an object."""
        classes = np.unique([index for indices in wanted.values() for index in indices]).astype(np.int64)
        found = found.take(np.flatnonzero(np.isin(found.classes, classes)))
        return suppress(found, self._settings.max_iou, self._settings.max_boxes, across_classes=False)

    def _classes(self, query: str) -> tuple[int, ...]:
        return classes_for(query, self.class_names, self._vectors)


def load_yolo(model: OpenModel) -> YoloSegDetector:
    """The detector with its defaults and the text vectors that lie beside the file. Raises ModelFileError."""
    return YoloSegDetector(model, TextEmbeddings.from_model_folder(model.path))
