"""Detect any noun with a YOLO network whose class vectors are an input, as YOLO-World with text features has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import NounMatch
from gausslite.domain.relevance import DetectedBox
from gausslite.perception.box_size import BoxSizeLimits
from gausslite.perception.models.model_file import OpenModel, run_once
from gausslite.perception.phrase_vectors import PhraseVectors
from gausslite.perception.yolo_decode import Letterbox, decode, letterbox, suppress

_DEFAULT_SIDE_PX: Final = 640
_MAX_CLASSES: Final = 80


@dataclass(frozen=True, slots=True)
class PromptedYoloSettings:
    """Thresholds of score, overlap and size of the boxes."""

    min_score: float = 0.25
    nms_max_iou: float = 0.7
    max_boxes: int = 50
    box_limits: BoxSizeLimits = field(default_factory=BoxSizeLimits)

    def __post_init__(self) -> None:
        for name in ("min_score", "nms_max_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")


@dataclass(frozen=True, slots=True)
class PromptedInputs:
    """Names and sizes of the two inputs. classes: None accepts any number of text features."""

    image: str
    features: str
    height_px: int
    width_px: int
    classes: int | None
    dimensions: int

    @classmethod
    def of(cls, path: Path, session: Any) -> PromptedInputs:
        """Return the inputs of a network. Raises ModelFileError if they are not an image and text features."""
        if not is_prompted(session):
            received = ", ".join(f"{each.name} {each.shape} {each.type}" for each in session.get_inputs())
            raise ModelFileError(f"model {path}: expected inputs [1, 3, h, w] and [1, c, d], got {received}")
        image, features = sorted(session.get_inputs(), key=lambda each: -len(each.shape))
        height_px, width_px = (side if isinstance(side, int) else _DEFAULT_SIDE_PX for side in image.shape[2:])
        classes = features.shape[1] if isinstance(features.shape[1], int) else None
        return cls(image.name, features.name, height_px, width_px, classes, features.shape[2])


class PromptedYolo:
    """A BoxDetector for any noun that has text features.

    Outputs: [1, 4+c, A] (centre x, y, width, height, c scores), or the two outputs of YOLO-World's own export, corners
    [1, A, 4] and scores [1, A, c]; all in pixels of the network's image.
    """

    def __init__(self, model: OpenModel, vectors: PhraseVectors, settings: PromptedYoloSettings | None = None) -> None:
        """Run the model once to check its outputs. Raises ModelFileError."""
        self._settings = settings or PromptedYoloSettings()
        self._path, self._session, self._vectors = model.path, model.session, vectors
        self._inputs = PromptedInputs.of(model.path, model.session)
        if vectors.dimensions != self._inputs.dimensions:
            raise ModelFileError(
                f"model {model.path}: expected text features of {self._inputs.dimensions} numbers, "
                f"got {vectors.dimensions} from {vectors.source}"
            )
        blank = np.zeros((1, 3, self._inputs.height_px, self._inputs.width_px), np.float32)
        features = np.full((1, self._inputs.classes or 1, vectors.dimensions), vectors.dimensions**-0.5, np.float32)
        self._rows(run_once(model, {self._inputs.image: blank, self._inputs.features: features}))

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what each query is searched as."""
        return tuple(self._vectors.match(query) for query in queries)

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return all instances of each query, best first, without boxes too large for their noun."""
        searched = [(query, self._vectors.vector(query)) for query in queries]
        known = [(query, vector) for query, vector in searched if vector is not None]
        tensor, letterboxing = letterbox(
            frame.sharpest_rgb, self._inputs.height_px, self._inputs.width_px, frame.rgb.shape[:2]
        )
        found: list[DetectedBox] = []
        step = self._inputs.classes or _MAX_CLASSES
        for start in range(0, len(known), step):
            batch = known[start : start + step]
            rows = self._infer(tensor, [vector for _, vector in batch])
            for index, (query, _) in enumerate(batch):
                found += self._select(query, rows[[0, 1, 2, 3, 4 + index]], letterboxing, frame)
        return found

    def _infer(
        self, tensor: Float32[ndarray, "1 3 H W"], vectors: Sequence[Float32[ndarray, " d"]]
    ) -> Float32[ndarray, "rows a"]:
        """Return the rows of box and scores. A fixed number of classes is filled by repeating the last vector.

        A repeated vector does not change the maximum over all texts, by which the network weights its image features.
        """
        count = self._inputs.classes or len(vectors)
        features = np.stack([*vectors, *[vectors[-1]] * (count - len(vectors))])[None]
        outputs = self._session.run(None, {self._inputs.image: tensor, self._inputs.features: features})
        return self._rows(outputs)

    def _rows(self, outputs: Sequence[Float32[ndarray, "..."]]) -> Float32[ndarray, "rows a"]:
        """Return centre x, y, width, height and the scores of each anchor. Raises ModelFileError for other shapes."""
        if len(outputs) == 1 and outputs[0].ndim == 3 and self._fits(outputs[0].shape[1] - 4):
            rows: Float32[ndarray, "rows a"] = outputs[0][0]
            return rows
        if len(outputs) == 2 and all(each.ndim == 3 for each in outputs):
            scores, corners = sorted((each[0] for each in outputs), key=lambda each: each.shape[1] == 4)
            if corners.shape == (len(scores), 4) and self._fits(scores.shape[1]):
                low, high = corners[:, :2], corners[:, 2:]
                return np.concatenate([(low + high) / 2, high - low, scores], axis=1).T.astype(np.float32)
        received = " and ".join(str(list(each.shape)) for each in outputs)
        count = self._inputs.classes or 1
        raise ModelFileError(
            f"model {self._path}: expected one output [1, {4 + count}, A], or boxes [1, A, 4] and scores "
            f"[1, A, {count}], got {received}"
        )

    def _fits(self, classes: int) -> bool:
        return classes >= 1 and self._inputs.classes in (None, classes)

    def _select(
        self, query: str, rows: Float32[ndarray, "5 a"], letterboxing: Letterbox, frame: Frame
    ) -> list[DetectedBox]:
        size_px = (frame.camera.height_px, frame.camera.width_px)
        candidates = decode(rows, 1, letterboxing, size_px, self._settings.min_score)
        kept = suppress(candidates, self._settings.nms_max_iou, self._settings.max_boxes, across_classes=True)
        boxes = []
        for score, corners in zip(kept.scores, kept.boxes_px, strict=True):
            left, top, right, bottom = (float(edge) for edge in corners)
            boxes.append(DetectedBox(query, float(score), (left, top, right, bottom)))
        limits = self._settings.box_limits
        return [each for each in boxes if limits.accepts(query, each.score, each.box_px, frame)]


def is_prompted(session: Any) -> bool:
    """Return True if the inputs are an image [1, 3, h, w] and text features [1, c, d] of known length d."""
    shapes = sorted((each.shape for each in session.get_inputs()), key=len)
    return (
        [len(shape) for shape in shapes] == [3, 4]
        and shapes[1][1] == 3
        and isinstance(shapes[0][2], int)
        and all(each.type == "tensor(float)" for each in session.get_inputs())
    )
