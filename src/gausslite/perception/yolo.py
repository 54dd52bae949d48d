"""A YOLO-seg network in an ONNX file of the user's: boxes and masks of a fixed set of classes, asked for by nouns."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection
from gausslite.errors import InvalidInputError, ModelFileError
from gausslite.perception.detect import BoxFractions, box_iou, concerns_many_objects
from gausslite.perception.model_file import open_session
from gausslite.perception.vectors import TextVectors, classes_for
from gausslite.perception.yolo_decode import (
    MASK_COEFFICIENTS,
    Candidates,
    Letterbox,
    decode,
    letterbox,
    mask_of,
    suppress,
)

_DEFAULT_SIDE_PX: Final = 640
_ANYTHING_SCORE: Final = 0.03
_ANYTHING_IOU: Final = 0.7


@dataclass(frozen=True, slots=True)
class YoloSettings:
    """How sure and how distinct a box must be; threads None leaves the choice to the runtime."""

    min_score: float = 0.25
    max_iou: float = 0.7
    max_boxes: int = 100
    min_segment_iou: float = 0.5
    box_fractions: BoxFractions = field(default_factory=BoxFractions)
    threads: int | None = None

    def __post_init__(self) -> None:
        for name in ("min_score", "max_iou", "min_segment_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")
        if self.threads is not None and self.threads < 1:
            raise InvalidInputError(f"detector threads: expected at least 1, got {self.threads}")


class YoloSegDetector:
    """A Detector and a Segmenter over one YOLO-seg file with outputs [1, 4+c+32, A] and [1, 32, h, w]."""

    def __init__(
        self, model_path: Path, vectors: TextVectors | None = None, settings: YoloSettings | None = None
    ) -> None:
        """Open and try the model once, so that a wrong file is refused here. Raises ModelFileError.

        Without vectors, nouns find their classes by name and by a short list of synonyms alone.
        """
        self._settings = settings or YoloSettings()
        self._vectors = vectors
        self._session = open_session(model_path, self._settings.threads)
        self._input, self._height_px, self._width_px = _input_of(model_path, self._session)
        outputs = _try_once(model_path, self._session, self._input, (self._height_px, self._width_px))
        _require_masks(model_path, outputs)
        self._names = _class_names(model_path, self._session)
        self._boxes_at, self._prototypes_at = _output_order(model_path, outputs, len(self._names))
        self._warnings: dict[str, None] = {}

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that the network knows."""
        return self._names

    @property
    def warnings(self) -> tuple[str, ...]:
        """The queries that no class of the network fits."""
        return tuple(self._warnings)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """All instances of each query with their masks, best first; boxes that span too much are left out."""
        wanted = {query: self._classes(query) for query in queries}
        if not any(wanted.values()):
            return []
        output, prototypes, placed = self._run(frame)
        size_px = (frame.camera.height_px, frame.camera.width_px)
        found = decode(output, placed, size_px, self._settings.min_score)
        classes = np.unique([index for indices in wanted.values() for index in indices]).astype(np.int64)
        found = found.take(np.flatnonzero(np.isin(found.classes, classes)))
        found = suppress(found, self._settings.max_iou, self._settings.max_boxes, across_classes=False)
        masks = self._masks(found, prototypes, placed, size_px)
        many = concerns_many_objects(queries)
        areas = (found.boxes_px[:, 2:] - found.boxes_px[:, :2]).prod(axis=1) / (size_px[0] * size_px[1])
        detections = []
        for query, indices in wanted.items():
            for row in np.flatnonzero(np.isin(found.classes, indices)):
                limit = self._settings.box_fractions.limit(self._names[found.classes[row]], many)
                if areas[row] <= limit and masks[row].any():
                    left, top, right, bottom = (float(edge) for edge in found.boxes_px[row])
                    box_px = (left, top, right, bottom)
                    detections.append(Detection(query, float(found.scores[row]), box_px, masks[row]))
        return detections

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """For each box the mask of the instance, of any class, that overlaps it best and by min_segment_iou or more."""
        if len(boxes_px) == 0:
            return []
        output, prototypes, placed = self._run(frame)
        size_px = (frame.camera.height_px, frame.camera.width_px)
        found = decode(output, placed, size_px, _ANYTHING_SCORE)
        found = suppress(found, _ANYTHING_IOU, self._settings.max_boxes, across_classes=True)
        if len(found.scores) == 0:
            return [None] * len(boxes_px)
        overlaps = box_iou(boxes_px, found.boxes_px)
        best = overlaps.argmax(axis=1)
        matched = overlaps.max(axis=1) >= self._settings.min_segment_iou
        masks = self._masks(found.take(best), prototypes, placed, size_px)
        return [mask if fits and mask.any() else None for mask, fits in zip(masks, matched, strict=True)]

    def _classes(self, query: str) -> tuple[int, ...]:
        classes = classes_for(query, self._names, self._vectors)
        if not classes:
            self._warnings[f"no class of the detector fits {query!r}: it will not be found"] = None
        return classes

    def _run(self, frame: Frame) -> tuple[Float32[ndarray, "rows a"], Float32[ndarray, "32 ph pw"], Letterbox]:
        tensor, placed = letterbox(frame.rgb, self._height_px, self._width_px)
        outputs = self._session.run(None, {self._input: tensor})
        return outputs[self._boxes_at][0], outputs[self._prototypes_at][0], placed

    def _masks(
        self,
        found: Candidates,
        prototypes: Float32[ndarray, "32 ph pw"],
        placed: Letterbox,
        size_px: tuple[int, int],
    ) -> list[Bool[ndarray, "h w"]]:
        sizes_px = (size_px, (self._height_px, self._width_px))
        return [
            mask_of(coefficients, prototypes, box, placed, sizes_px)
            for coefficients, box in zip(found.coefficients, found.boxes_px, strict=True)
        ]


def load_yolo(model_path: Path, threads: int | None = None) -> YoloSegDetector:
    """The detector with its defaults and the text vectors that lie beside the file. Raises ModelFileError."""
    return YoloSegDetector(model_path, TextVectors.beside(model_path), YoloSettings(threads=threads))


def _input_of(path: Path, session: Any) -> tuple[str, int, int]:
    inputs = session.get_inputs()
    shape = inputs[0].shape
    if len(inputs) != 1 or len(shape) != 4 or shape[1] not in (3, None) or inputs[0].type != "tensor(float)":
        came = ", ".join(f"{each.name} {each.shape} {each.type}" for each in inputs)
        raise ModelFileError(f"model {path}: expected one float input [1, 3, height, width], got {came}")
    height, width = (side if isinstance(side, int) else _DEFAULT_SIDE_PX for side in shape[2:])
    return str(inputs[0].name), height, width


def _class_names(path: Path, session: Any) -> tuple[str, ...]:
    text = session.get_modelmeta().custom_metadata_map.get("names", "")
    try:
        names = ast.literal_eval(text)
        ordered = tuple(str(names[index]) for index in range(len(names)))
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        ordered = ()
    if not ordered:
        raise ModelFileError(f"model {path}: expected class names in the metadata field 'names', got {text[:60]!r}")
    return ordered


def _try_once(path: Path, session: Any, name: str, size_px: tuple[int, int]) -> list[Float32[ndarray, "..."]]:
    """Shapes may be open in the file, and some damage shows only when the network runs."""
    try:
        outputs: list[Float32[ndarray, "..."]] = session.run(None, {name: np.zeros((1, 3, *size_px), np.float32)})
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ModelFileError(f"model {path}: expected a network that runs, but {reason}") from error
    return outputs


def _require_masks(path: Path, outputs: list[Float32[ndarray, "..."]]) -> None:
    if len(outputs) != 2:
        came = " and ".join(str(list(each.shape)) for each in outputs)
        hint = " (boxes only, no masks)" if len(outputs) == 1 else ""
        raise ModelFileError(
            f"model {path}: expected a YOLO-seg network with outputs [1, 4+c+32, A] and [1, 32, h, w], got {came}{hint}"
        )


def _output_order(path: Path, outputs: list[Float32[ndarray, "..."]], classes: int) -> tuple[int, int]:
    rows = 4 + classes + MASK_COEFFICIENTS
    boxes = [i for i, each in enumerate(outputs) if each.ndim == 3 and each.shape[:2] == (1, rows)]
    prototypes = [i for i, each in enumerate(outputs) if each.ndim == 4 and each.shape[:2] == (1, MASK_COEFFICIENTS)]
    if len(boxes) != 1 or len(prototypes) != 1:
        came = " and ".join(str(list(each.shape)) for each in outputs)
        raise ModelFileError(
            f"model {path}: expected outputs [1, {rows}, A] for {classes} classes and [1, 32, h, w], got {came}"
        )
    return boxes[0], prototypes[0]
