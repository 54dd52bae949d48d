"""Detect any noun phrase: Grounding DINO, and YOLO networks whose class vectors are an input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import DetectedBox
from gausslite_detectors.boxes import BoxSizeLimits
from gausslite_detectors.layouts import anchors_reading
from gausslite_detectors.model_file import OpenModel, run_once
from gausslite_detectors.network import (
    MEAN,
    STANDARD_DEVIATION,
    Letterbox,
    boxes_in_image,
    candidates_of,
    letterbox,
    suppress,
)
from gausslite_detectors.text_features import PhraseInput, PhraseVectors, Tokenizer, encode_phrase

INPUTS: Final = ("pixel_values", "input_ids", "attention_mask", "token_type_ids", "pixel_mask")
OUTPUTS: Final = ("logits", "pred_boxes")
_REQUIRED_INPUTS: Final = frozenset({"pixel_values", "input_ids"})
_SHORT_SIDE_PX: Final = 800
_LONG_SIDE_PX: Final = 1333
_TEST_PHRASE: Final = "object"


@dataclass(frozen=True, slots=True)
class GroundingSettings:
    """Thresholds of the boxes (comment in Sec. III-B.2): box_score of the phrase, text_score of its head noun.

    text_score keeps "red mug" from matching objects that are only red. nms_max_iou is not in the paper: it removes rare
    duplicate boxes of one object.
    """

    box_score: float = 0.20
    text_score: float = 0.25
    nms_max_iou: float = 0.7
    max_boxes: int = 50
    box_limits: BoxSizeLimits = field(default_factory=BoxSizeLimits)

    def __post_init__(self) -> None:
        for name in ("box_score", "text_score", "nms_max_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"detector {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_boxes <= 1000:
            raise InvalidInputError(f"detector max_boxes: expected 1 to 1000, got {self.max_boxes}")


class GroundingDino:
    """A BoxDetector for any phrase; encoded phrases are cached."""

    def __init__(self, model: OpenModel, tokenizer: Tokenizer, settings: GroundingSettings | None = None) -> None:
        """Run the model once to check its outputs. Raises ModelFileError."""
        self._settings = settings or GroundingSettings()
        self._tokenizer = tokenizer
        self._session = model.session
        self._types = _input_types(model.path, self._session)
        shapes = {port.name: port.shape for port in self._session.get_inputs()}
        self._size_px = tuple(side if isinstance(side, int) else None for side in shapes["pixel_values"][2:])
        length = shapes["input_ids"][1]
        self._length = length if isinstance(length, int) else None
        self._phrases: dict[str, PhraseInput] = {}
        self._best: dict[str, DetectedBox] = {}
        self._check_outputs(model)

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return a match for every query: the network accepts any phrase."""
        least = self._settings.text_score
        return tuple(NounMatch(query, MatchBasis.PHRASE, min_score=least) for query in queries)

    def best_boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the box of each query whose noun has the best score in the frame of the latest `boxes`."""
        del frame
        return [self._best[query] for query in queries if query in self._best]

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return all instances of each query, best first, without boxes too large for their noun."""
        pixel_values, pixel_mask = self._preprocess(frame.sharpest_rgb)
        found: list[DetectedBox] = []
        for query in queries:
            logits, boxes_cxcywh = self._run(pixel_values, pixel_mask, self._encoded_phrase(query))
            found += self._select_boxes(query, logits, boxes_cxcywh, frame)
        return found

    def _select_boxes(
        self,
        query: str,
        logits: Float32[ndarray, "q l"],
        boxes_cxcywh: Float32[ndarray, "q 4"],
        frame: Frame,
    ) -> list[DetectedBox]:
        """Return the boxes above the thresholds, not too large, after non-maximum suppression."""
        scores, noun_scores = phrase_scores(logits, self._encoded_phrase(query).is_noun)
        boxes_px = corners_px(boxes_cxcywh, (frame.camera.width_px, frame.camera.height_px))
        areas = (boxes_px[:, 2:] - boxes_px[:, :2]).prod(axis=1)
        self._best[query] = best_box(query, noun_scores, boxes_px)
        is_match = (scores >= self._settings.box_score) & (noun_scores >= self._settings.text_score)
        rows = np.flatnonzero(is_match & (areas > 0))
        if len(rows) == 0:
            return []
        boxes = boxes_px[rows].astype(np.float64)
        boxes[:, 2:] -= boxes[:, :2]
        order = cv2.dnn.NMSBoxes(boxes.tolist(), scores[rows].tolist(), 0.0, self._settings.nms_max_iou)
        selected = rows[np.asarray(order, np.int64).reshape(-1)[: self._settings.max_boxes]]
        found = []
        for row in selected:
            left, top, right, bottom = (float(edge) for edge in boxes_px[row])
            found.append(DetectedBox(query, float(scores[row]), (left, top, right, bottom)))
        limits = self._settings.box_limits
        return [box for box in found if limits.accepts(query, box.score, box.box_px, frame)]

    def _encoded_phrase(self, query: str) -> PhraseInput:
        if query not in self._phrases:
            self._phrases[query] = encode_phrase(query, self._tokenizer, self._length)
        return self._phrases[query]

    def _preprocess(self, rgb: UInt8[ndarray, "h w 3"]) -> tuple[Float32[ndarray, "1 3 H W"], Int64[ndarray, "1 H W"]]:
        """Return image and mask in the network's size; proportions are kept if the network accepts a mask."""
        height, width = self._size_px
        if height is None or width is None:
            return preprocess(rgb, training_size_px(rgb.shape[0], rgb.shape[1]), keep_proportions=True)
        return preprocess(rgb, (height, width), keep_proportions="pixel_mask" in self._types)

    def _run(
        self, pixel_values: Float32[ndarray, "1 3 H W"], pixel_mask: Int64[ndarray, "1 H W"], phrase: PhraseInput
    ) -> tuple[Float32[ndarray, "q l"], Float32[ndarray, "q 4"]]:
        logits, boxes = self._session.run(list(OUTPUTS), self._inputs(pixel_values, pixel_mask, phrase))
        return logits[0].astype(np.float32), boxes[0].astype(np.float32)

    def _inputs(
        self, pixel_values: Float32[ndarray, "1 3 H W"], pixel_mask: Int64[ndarray, "1 H W"], phrase: PhraseInput
    ) -> dict[str, Any]:
        arrays = (pixel_values, phrase.input_ids, phrase.attention_mask, phrase.token_type_ids, pixel_mask)
        inputs = zip(INPUTS, arrays, strict=True)
        return {name: array.astype(self._types[name]) for name, array in inputs if name in self._types}

    def _check_outputs(self, model: OpenModel) -> None:
        rgb = np.zeros((48, 64, 3), np.uint8)
        outputs = run_once(model, self._inputs(*self._preprocess(rgb), self._encoded_phrase(_TEST_PHRASE)))
        shapes = {port.name: out.shape for port, out in zip(self._session.get_outputs(), outputs, strict=True)}
        logits, boxes = shapes["logits"], shapes["pred_boxes"]
        tokens = self._encoded_phrase(_TEST_PHRASE).input_ids.shape[1]
        if not (len(logits) == 3 and logits[2] >= tokens and boxes == (1, logits[1], 4) and logits[0] == 1):
            raise ModelFileError(
                f"model {model.path}: expected logits [1, q, {tokens} or more] and pred_boxes [1, q, 4], "
                f"got {list(logits)} and {list(boxes)}"
            )


def best_box(query: str, scores: Float32[ndarray, " n"], boxes_px: Float32[ndarray, "n 4"]) -> DetectedBox:
    """Return the box with the best score."""
    row = int(scores.argmax())
    left, top, right, bottom = (float(edge) for edge in boxes_px[row])
    return DetectedBox(query, float(scores[row]), (left, top, right, bottom), is_weak=True)


def phrase_scores(
    logits: Float32[ndarray, "q l"], is_noun: Sequence[bool]
) -> tuple[Float32[ndarray, " q"], Float32[ndarray, " q"]]:
    """Return per box the score of the phrase (maximum over all tokens) and of its head noun's tokens."""
    # the logit is -inf if there is no token
    probabilities = 1.0 / (1.0 + np.exp(-np.clip(logits, -80.0, 80.0)))
    noun_tokens = np.zeros(logits.shape[1], np.bool_)
    noun_tokens[: len(is_noun)] = is_noun
    noun_scores = probabilities[:, noun_tokens].max(axis=1) if noun_tokens.any() else np.zeros(len(logits))
    return probabilities.max(axis=1).astype(np.float32), noun_scores.astype(np.float32)


def corners_px(boxes_cxcywh: Float32[ndarray, "q 4"], size_px: tuple[int, int]) -> Float32[ndarray, "q 4"]:
    """Return relative boxes (centre x, y, width, height) as corners in pixels, clipped to size_px (width, height)."""
    half = boxes_cxcywh[:, 2:] / 2
    corners = np.concatenate([boxes_cxcywh[:, :2] - half, boxes_cxcywh[:, :2] + half], axis=1)
    size = np.array([*size_px, *size_px], np.float32)
    clipped: Float32[ndarray, "q 4"] = np.clip(corners * size, 0, size).astype(np.float32)
    return clipped


def training_size_px(height_px: int, width_px: int) -> tuple[int, int]:
    """Return the network's training size (height, width): 800 on the short side, at most 1333 on the long side."""
    short, long = sorted((height_px, width_px))
    scale = min(_SHORT_SIDE_PX / short, _LONG_SIDE_PX / long)
    return max(1, round(height_px * scale)), max(1, round(width_px * scale))


def preprocess(
    rgb: UInt8[ndarray, "h w 3"], size_px: tuple[int, int], keep_proportions: bool
) -> tuple[Float32[ndarray, "1 3 H W"], Int64[ndarray, "1 H W"]]:
    """Return the normalised image, scaled into size_px (height, width) at the top left corner, and its mask.

    The network's boxes are relative to the masked part and need no correction for the padding.
    """
    (height, width), (h, w) = size_px, rgb.shape[:2]
    scale_y, scale_x = height / h, width / w
    if keep_proportions:
        scale_y = scale_x = min(scale_y, scale_x)
    inner_h, inner_w = min(height, max(1, round(h * scale_y))), min(width, max(1, round(w * scale_x)))
    shrinks = inner_w < w
    scaled = cv2.resize(rgb, (inner_w, inner_h), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    values = np.zeros((1, 3, height, width), np.float32)
    normalised = (scaled.astype(np.float32) / 255 - MEAN) / STANDARD_DEVIATION
    values[0, :, :inner_h, :inner_w] = normalised.transpose(2, 0, 1)
    mask = np.zeros((1, height, width), np.int64)
    mask[:, :inner_h, :inner_w] = 1
    return values, mask


def is_grounding(names_in: Sequence[str], names_out: Sequence[str]) -> bool:
    """Return True for a network with the inputs and outputs of Grounding DINO."""
    return set(names_in) >= _REQUIRED_INPUTS and set(OUTPUTS) <= set(names_out)


def _input_types(path: Path, session: Any) -> dict[str, type[np.generic]]:
    """Return the type of each input. Raises ModelFileError if inputs or outputs are not those of Grounding DINO."""
    known = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(int64)": np.int64,
             "tensor(int32)": np.int32, "tensor(bool)": np.bool_}  # fmt: skip
    inputs = {port.name: port for port in session.get_inputs()}
    outputs = [port.name for port in session.get_outputs()]
    is_supported = (
        is_grounding(list(inputs), outputs)
        and set(inputs) <= set(INPUTS)
        and all(port.type in known for port in inputs.values())
        and len(inputs["pixel_values"].shape) == 4
        and len(inputs["input_ids"].shape) == 2
    )
    if not is_supported:
        received = ", ".join(f"{port.name} {port.shape} {port.type}" for port in inputs.values())
        raise ModelFileError(
            f"model {path}: expected Grounding DINO with inputs {', '.join(INPUTS)} and outputs {', '.join(OUTPUTS)}, "
            f"got {received} and {', '.join(outputs)}"
        )
    return {name: known[port.type] for name, port in inputs.items()}


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
            received = ", ".join(f"{port.name} {port.shape} {port.type}" for port in session.get_inputs())
            raise ModelFileError(f"model {path}: expected inputs [1, 3, h, w] and [1, c, d], got {received}")
        image, features = sorted(session.get_inputs(), key=lambda port: -len(port.shape))
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
        self._best: dict[str, DetectedBox] = {}
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
        least = self._settings.min_score
        return tuple(replace(self._vectors.match(query), min_score=least) for query in queries)

    def best_boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the box of each query with the best score in the frame of the latest `boxes`."""
        del frame
        return [self._best[query] for query in queries if query in self._best]

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
        if len(outputs) == 2 and all(output.ndim == 3 for output in outputs):
            scores, corners = sorted((output[0] for output in outputs), key=lambda output: output.shape[1] == 4)
            if corners.shape == (len(scores), 4) and self._fits(scores.shape[1]):
                low, high = corners[:, :2], corners[:, 2:]
                return np.concatenate([(low + high) / 2, high - low, scores], axis=1).T.astype(np.float32)
        received = " and ".join(str(list(output.shape)) for output in outputs)
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
        reading = anchors_reading(rows, 1, np.zeros((0, 1, 1), np.float32))
        every = boxes_in_image(reading.boxes, letterboxing, size_px)
        self._best[query] = best_box(query, reading.scores, every)
        candidates = candidates_of(reading, letterboxing, size_px, self._settings.min_score)
        kept = suppress(candidates, self._settings.nms_max_iou, self._settings.max_boxes, across_classes=True)
        boxes = []
        for score, corners in zip(kept.scores, kept.boxes_px, strict=True):
            left, top, right, bottom = (float(edge) for edge in corners)
            boxes.append(DetectedBox(query, float(score), (left, top, right, bottom)))
        limits = self._settings.box_limits
        return [box for box in boxes if limits.accepts(query, box.score, box.box_px, frame)]


def is_prompted(session: Any) -> bool:
    """Return True if the inputs are an image [1, 3, h, w] and text features [1, c, d] of known length d."""
    shapes = sorted((port.shape for port in session.get_inputs()), key=len)
    return (
        [len(shape) for shape in shapes] == [3, 4]
        and shapes[1][1] == 3
        and isinstance(shapes[0][2], int)
        and all(port.type == "tensor(float)" for port in session.get_inputs())
    )
