"""How the outputs of a detection network are laid out, by their shapes, types and metadata; others are refused by name.

Each layout becomes a `Reading`: boxes, the class and score of each candidate, and what masks are made from.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.errors import ModelFileError
from gausslite_detectors.class_names import COCO_NAMES, class_count, names_file, names_of, stated_names

Array = ndarray[Any, np.dtype[Any]]
_YOLO_LINE: Final = "export it with Ultralytics (AGPL-3.0): yolo export model=yolo11n-seg.pt format=onnx"
_FREE_LINE: Final = (
    "a detector under Apache-2.0 is made with: "
    'python -c "from rfdetr import RFDETRSegNano; RFDETRSegNano().export()"; `gausslite models list` has others'
)
_TASKS: Final = {"pose": "keypoints", "obb": "rotated boxes", "classify": "one class per image",
                 "semantic": "one class per pixel"}  # fmt: skip


class ModelFamily(StrEnum):
    """Supported networks."""

    RF_DETR = "RF-DETR"
    RT_DETR = "RT-DETR or D-FINE"
    YOLO_SEG = "YOLO-seg or FastSAM"
    YOLO_BOXES = "YOLO with class names"
    PROMPTED_YOLO = "YOLO with text features"
    GROUNDING_DINO = "Grounding DINO"
    TEXT_ENCODER = "text encoder"


class ImageFit(StrEnum):
    """How an image becomes a network's: centred on grey, or stretched, then from 0 to 1, or normalised as ImageNet."""

    LETTERBOX = "letterbox"
    STRETCH = "stretch"
    NORMALISE = "normalise"


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a network found in one image. rows: the box of each candidate.

    Boxes are corners (left, top, right, bottom) in pixels of the network's image, or all in shares of its sides.
    coefficients: weights of each box's mask in masks, k x h x w prototypes; of no columns if masks are those of the
    boxes, n x h x w, or if there are none.
    """

    boxes: Float32[ndarray, "n 4"]
    rows: Int64[ndarray, " m"]
    classes: Int64[ndarray, " m"]
    scores: Float32[ndarray, " m"]
    coefficients: Float32[ndarray, "n k"]
    masks: Float32[ndarray, "p h w"]
    peak_rows: Int64[ndarray, " c"]
    """The box of each class with its best score, whatever else that box rather shows."""
    peak_scores: Float32[ndarray, " c"]


Decoder = Callable[[Sequence[Array]], Reading]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """How a network's image is made and its outputs are read.

    names: of each class index, empty if the file states none. is_final: no box of an object is repeated.
    """

    family: ModelFamily
    names: tuple[str, ...]
    classes: int
    has_masks: bool
    fit: ImageFit
    is_final: bool
    decode: Decoder


@dataclass(frozen=True, slots=True, eq=False)
class Outputs:
    """The outputs for a blank image, the first of a batch, with their names; and what the file states."""

    path: Path
    names: tuple[str, ...]
    arrays: tuple[Array, ...]
    metadata: Mapping[str, str]

    def shaped(self, dimensions: int) -> list[int]:
        """Return the indices of the outputs with this number of dimensions."""
        return [index for index, array in enumerate(self.arrays) if array.ndim == dimensions]

    def named(self, *parts: str) -> list[int]:
        """Return the indices of the outputs whose name contains one of these parts."""
        return [index for index, name in enumerate(self.names) if any(part in name.lower() for part in parts)]

    def describe(self) -> str:
        """Return names and shapes, for messages."""
        pairs = zip(self.names, self.arrays, strict=True)
        return ", ".join(f"{name} [{', '.join(map(str, (1, *array.shape)))}]" for name, array in pairs)


def layout_of(outputs: Outputs) -> Layout:
    """Return the layout of a network's outputs. Raises ModelFileError with what they are, and the right export."""
    task = outputs.metadata.get("task", "")
    if task in _TASKS:
        raise _refusal(outputs, f"a network of the task {task}, which finds {_TASKS[task]}", _YOLO_LINE)
    for find in (_query_layout, _labelled_layout, _yolo_layout):
        layout = find(outputs)
        if layout is not None:
            return layout
    raise _refusal(outputs, *_reason(outputs))


def _refusal(outputs: Outputs, what: str, line: str) -> ModelFileError:
    return ModelFileError(f"model {outputs.path}: expected a detector, got {what}: {outputs.describe()}; {line}")


def _reason(outputs: Outputs) -> tuple[str, str]:
    """Return what outputs without a layout are, and the line that exports such a network right."""
    shapes = [array.shape for array in outputs.arrays]
    count = len(stated_names(outputs.path, outputs.metadata))
    sides = {side for shape in shapes if len(shape) == 2 for side in shape}
    line = _YOLO_LINE if "ultralytics" in outputs.metadata.get("author", "").lower() else _FREE_LINE
    if len(shapes) >= 3 and all(len(shape) in (3, 4) for shape in shapes):
        return "the feature maps of a network without its last layers", line
    if shapes == [(7,)] and count != 7:
        return "one list of boxes for all images of a batch, as YOLOv7's end2end has it", "export it without end2end"
    if all(len(shape) == 1 for shape in shapes):
        return "one list of numbers per image, as networks that classify whole images have", line
    if any(len(shape) == 2 and shape[1] == 5 for shape in shapes) and outputs.named("dets"):
        return "boxes with scores and labels as MMDeploy writes them", line
    if (count and 5 + count in sides) or (not count and 85 in sides):
        return "boxes with objectness, as YOLOv5 and YOLOX have them", line
    if count and sides:
        fits = f"[1, {4 + count}, A], or [1, {4 + count}+k, A] and [1, k, h, w], or with nms=True [1, n, 6]"
        return f"outputs that do not fit its {count} class names (expected {fits})", line
    if sides:
        names = f"{names_file(outputs.path).name} beside it, one name per line"
        return f"no class names in the metadata field 'names' or in {names}", line
    return "outputs of no known detector", line


def _query_layout(outputs: Outputs) -> Layout | None:
    """Return the layout of RF-DETR and its relatives: boxes [Q, 4] in shares, class logits [Q, C], masks [Q, h, w]."""
    tables, maps = outputs.shaped(2), outputs.shaped(3)
    if len(tables) != 2 or len(maps) > 1 or len(tables) + len(maps) != len(outputs.arrays):
        return None
    of_boxes = [index for index in outputs.named("dets", "box") if index in tables]
    of_boxes = of_boxes or [index for index in tables if outputs.arrays[index].shape[1] == 4]
    boxes = of_boxes[0] if of_boxes else tables[0]
    (logits,) = (index for index in tables if index != boxes)
    (queries, sides), (rows, classes) = outputs.arrays[boxes].shape, outputs.arrays[logits].shape
    is_fitting = sides == 4 and rows == queries and all(len(outputs.arrays[index]) == queries for index in maps)
    # the query boxes are shares; decoded anchors of a YOLO are pixels
    if not is_fitting or np.abs(outputs.arrays[boxes]).max(initial=0.0) > _MAX_SHARE:
        return None
    names = names_of(stated_names(outputs.path, outputs.metadata), classes)
    if not names:
        names_beside = f"names, or in {names_file(outputs.path).name} beside it"
        raise _refusal(
            outputs,
            f"no names of its {classes - 1} classes (and one of the background) in the metadata field {names_beside}",
            "export it with: model.export(notes=model.class_names)",
        )

    def decode(arrays: Sequence[Array]) -> Reading:
        scores = _sigmoid(arrays[logits].astype(np.float32))
        best = np.argsort(-scores, axis=None, kind="stable")[:queries]
        of_boxes = _corners(arrays[boxes].astype(np.float32))
        own = arrays[maps[0]].astype(np.float32) if maps else _NO_MASKS
        chosen = best // classes, best % classes, scores.ravel()[best]
        return Reading(of_boxes, *chosen, _none(queries), own, scores.argmax(axis=0), scores.max(axis=0))

    is_hugging_face = bool(outputs.named("logits")) and classes != len(names_of({}, 91))
    fit = ImageFit.STRETCH if is_hugging_face else ImageFit.NORMALISE
    family = ModelFamily.RT_DETR if is_hugging_face else ModelFamily.RF_DETR
    return Layout(
        family=family, names=names, classes=classes, has_masks=bool(maps), fit=fit, is_final=True, decode=decode
    )


def _labelled_layout(outputs: Outputs) -> Layout | None:
    """Return the layout of boxes [n, 4] with scores [n] and labels [n], with masks [n, h, w] and a count or without."""
    lists, tables, maps = outputs.shaped(1), outputs.shaped(2), outputs.shaped(3)
    counts = [index for index in outputs.named("num") if index in lists]
    lists = [index for index in lists if index not in counts]
    if len(lists) != 2 or len(tables) != 1 or len(maps) > 1 or outputs.arrays[tables[0]].shape[1] != 4:
        return None
    of_labels = [index for index in outputs.named("label", "class", "cls") if index in lists]
    of_labels = of_labels or [index for index in lists if outputs.arrays[index].dtype.kind in "iu"]
    labels = of_labels[0] if len(of_labels) == 1 else lists[0]
    (scored,) = (index for index in lists if index != labels)
    stated = stated_names(outputs.path, outputs.metadata)
    classes = class_count(stated) or len(COCO_NAMES)
    names = names_of(stated, classes)

    def decode(arrays: Sequence[Array]) -> Reading:
        scores = arrays[scored].astype(np.float32)
        if counts:
            scores = np.where(np.arange(len(scores)) < int(arrays[counts[0]][0]), scores, np.float32(0))
        own = arrays[maps[0]].astype(np.float32) if maps else _NO_MASKS
        of_boxes, of_classes = arrays[tables[0]].astype(np.float32), arrays[labels].astype(np.int64)
        return _single(of_boxes, of_classes, scores, _none(len(scores)), own, classes)

    fit = ImageFit.LETTERBOX if counts else ImageFit.STRETCH
    family = ModelFamily.YOLO_BOXES if counts else ModelFamily.RT_DETR
    return Layout(
        family=family, names=names, classes=classes, has_masks=bool(maps), fit=fit, is_final=True, decode=decode
    )


def _yolo_layout(outputs: Outputs) -> Layout | None:
    """Return the layout of [4+c+k, A], in either order, or of suppressed boxes [n, 6+k]; with k prototypes of masks."""
    tables, maps = outputs.shaped(2), outputs.shaped(3)
    if len(tables) != 1 or len(maps) > 1:
        return None
    table, k = tables[0], outputs.arrays[maps[0]].shape[0] if maps else 0
    stated = stated_names(outputs.path, outputs.metadata)
    family = ModelFamily.YOLO_SEG if maps else ModelFamily.YOLO_BOXES

    def prototypes(arrays: Sequence[Array]) -> Array:
        return arrays[maps[0]].astype(np.float32) if maps else _NO_MASKS

    if stated and _is_listed(outputs, outputs.arrays[table], k):
        classes = class_count(stated)
        return Layout(
            family=family,
            names=names_of(stated, classes),
            classes=classes,
            has_masks=bool(maps),
            fit=ImageFit.LETTERBOX,
            is_final=True,
            decode=lambda arrays: _listed(arrays[table].astype(np.float32), prototypes(arrays), classes),
        )
    found = _classes_of_rows(outputs.arrays[table].shape, k, stated)
    if found is None:
        return None
    classes, is_transposed = found

    def decode(arrays: Sequence[Array]) -> Reading:
        rows = arrays[table].astype(np.float32)
        return anchors_reading(rows.T if is_transposed else rows, classes, prototypes(arrays))

    names = names_of(stated, classes)
    return Layout(
        family=family,
        names=names,
        classes=classes,
        has_masks=bool(maps),
        fit=ImageFit.LETTERBOX,
        is_final=False,
        decode=decode,
    )


def _is_listed(outputs: Outputs, table: Array, k: int) -> bool:
    """Return True for boxes after suppression: corners, score, class, and the coefficients of a mask."""
    arguments = _literal(outputs.metadata.get("args", ""))
    nms = arguments.get("nms") if isinstance(arguments, dict) else None
    is_stated = outputs.metadata.get("end2end", "").lower() == "true" or nms is True
    classes = table[:, 5] if table.shape[1] == 6 + k else np.array([0.5])
    has_corners = bool((table[:, 2:4] >= table[:, :2]).all()) if table.shape[1] == 6 + k else False
    return table.shape[1] == 6 + k and (is_stated or (has_corners and bool((classes == np.round(classes)).all())))


def _classes_of_rows(shape: tuple[int, ...], k: int, stated: Mapping[int, str]) -> tuple[int, bool] | None:
    """Return the number of classes of [4+c+k, A], and True for [A, 4+c+k]; None if neither fits the names."""
    counts = [class_count(stated), len(stated)] if stated else [len(COCO_NAMES)]
    for is_transposed in (False, True):
        rows = shape[1 if is_transposed else 0]
        if rows - 4 - k in counts:
            return rows - 4 - k, is_transposed
    if stated or not k:
        return None
    # a network that segments everything needs no names
    is_transposed = 5 + k <= shape[1] < shape[0]
    classes = (shape[1] if is_transposed else shape[0]) - 4 - k
    return (classes, is_transposed) if classes >= 1 else None


def _listed(table: Float32[ndarray, "n r"], prototypes: Float32[ndarray, "k h w"], count: int) -> Reading:
    return _single(table[:, :4], table[:, 5].astype(np.int64), table[:, 4], table[:, 6:], prototypes, count)


def _single(
    boxes: Float32[ndarray, "n 4"],
    classes: Int64[ndarray, " n"],
    scores: Float32[ndarray, " n"],
    coefficients: Float32[ndarray, "n k"],
    masks: Float32[ndarray, "p h w"],
    count: int,
) -> Reading:
    """Return the reading of boxes that have one of count classes each."""
    rows = np.arange(len(boxes))
    peak_rows, peak_scores = np.zeros(count, np.int64), np.zeros(count, np.float32)
    for row in np.argsort(scores, kind="stable"):
        if classes[row] < count:
            peak_rows[classes[row]], peak_scores[classes[row]] = row, scores[row]
    return Reading(
        boxes=boxes,
        rows=rows,
        classes=classes,
        scores=scores,
        coefficients=coefficients,
        masks=masks,
        peak_rows=peak_rows,
        peak_scores=peak_scores,
    )


def anchors_reading(output: Float32[ndarray, "r a"], classes: int, prototypes: Float32[ndarray, "k h w"]) -> Reading:
    """Return the best class of each anchor; r is centre x, y, width, height, the scores, and the coefficients."""
    scores = output[4 : 4 + classes]
    best = scores.argmax(axis=0)
    rows = np.arange(output.shape[1])
    peaks = scores.argmax(axis=1)
    peak_scores = scores[np.arange(classes), peaks]
    chosen = rows, best, scores[best, rows]
    return Reading(_corners(output[:4].T), *chosen, output[4 + classes :].T, prototypes, peaks, peak_scores)


_MAX_SHARE: Final = 2.0
"""Boxes without a larger number are shares of the image's sides: no network finds only boxes of two pixels."""
_MAX_SIDES: Final = 8.0
_LEAST_SCORE: Final = 0.1
"""Score from which a box must be one: networks do not learn where the others are."""
_NO_MASKS: Final = np.zeros((0, 1, 1), np.float32)


def in_pixels(reading: Reading, size_px: tuple[int, int], path: Path) -> Float32[ndarray, "n 4"]:
    """Return the boxes in pixels of the network's image of size_px (height, width). Raises ModelFileError."""
    boxes, seen = reading.boxes, reading.boxes[reading.rows[reading.scores >= _LEAST_SCORE]]
    largest = float(np.abs(boxes).max(initial=0.0))
    height_px, width_px = size_px
    if np.abs(seen).max(initial=0.0) > _MAX_SIDES * max(size_px) or (seen[:, 2:] < seen[:, :2]).any():
        raise ModelFileError(
            f"model {path}: expected boxes as corners in pixels of {height_px}x{width_px}, or from 0 to 1; got boxes "
            f"out of range, up to {largest:.0f}; {_FREE_LINE}"
        )
    if largest > _MAX_SHARE:
        return boxes
    scaled: Float32[ndarray, "n 4"] = boxes * np.array([width_px, height_px, width_px, height_px], np.float32)
    return scaled


class ScoreScale:
    """The scale of a network's scores: 0 to 1, logits, or percent. Use one per network, from one thread at a time.

    A score beyond 0 to 1 shows it once and for all: an image with little to see has small percents.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._is_logits = self._is_percent = False

    def to_unit(self, scores: Float32[ndarray, " n"]) -> Float32[ndarray, " n"]:
        """Return scores from 0 to 1. Raises ModelFileError for others than known scales, and for no numbers."""
        if not np.isfinite(scores).all():
            raise ModelFileError(
                f"model {self._path}: expected finite scores, got others, as half precision can make: "
                f"export it with half=False"
            )
        low, high = float(scores.min(initial=0.0)), float(scores.max(initial=0.0))
        # quantised networks leave 0 to 1 by a little
        self._is_logits = self._is_logits or low < -0.5
        self._is_percent = self._is_percent or (not self._is_logits and high > 1.5)
        if self._is_logits:
            return _sigmoid(scores)
        if self._is_percent and high > 101.0:
            raise ModelFileError(
                f"model {self._path}: expected scores from 0 to 1, logits or percent, got scores out of range, up to "
                f"{high:.0f}; {_FREE_LINE}"
            )
        return np.clip(scores / np.float32(100 if self._is_percent else 1), 0.0, 1.0).astype(np.float32)


def _sigmoid(logits: Float32[ndarray, "..."]) -> Float32[ndarray, "..."]:
    probabilities: Float32[ndarray, "..."] = 1.0 / (1.0 + np.exp(-np.clip(logits, -80.0, 80.0)))
    return probabilities.astype(np.float32)


def _corners(boxes_cxcywh: Float32[ndarray, "n 4"]) -> Float32[ndarray, "n 4"]:
    half = boxes_cxcywh[:, 2:] / 2
    return np.concatenate([boxes_cxcywh[:, :2] - half, boxes_cxcywh[:, :2] + half], axis=1)


def _none(rows: int) -> Float32[ndarray, "n 0"]:
    return np.zeros((rows, 0), np.float32)


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None


def stated_side_px(metadata: Mapping[str, str], axis: int, default_px: int) -> int:
    """Return the network's height (axis 0) or width (1) in the metadata field imgsz, or the default."""
    size = _literal(metadata.get("imgsz", ""))
    sides = size if isinstance(size, list | tuple) else [size]
    side = sides[min(axis, len(sides) - 1)] if sides else None
    return side if isinstance(side, int) and 0 < side <= 1 << 14 else default_px
