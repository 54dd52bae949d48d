"""Run a detection network: an image in, candidate boxes by class index out, with masks if the network has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite_detectors.class_names import names_file
from gausslite_detectors.layouts import ImageFit, Outputs, Reading, ScoreScale, in_pixels, layout_of, stated_side_px
from gausslite_detectors.model_file import OpenModel, run_once

_PAD_VALUE = 114
# normalisation of the training images of ImageNet: red, green, blue
MEAN: Final = np.array([0.485, 0.456, 0.406], np.float32)
STANDARD_DEVIATION: Final = np.array([0.229, 0.224, 0.225], np.float32)


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Scale and padding of an image: x_network = x_image · scale_x + left_px, and the same for y."""

    scale_x: float
    scale_y: float
    left_px: int
    top_px: int


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Boxes (left, top, right, bottom) in image pixels, each of a class. rows: of the network's boxes, for the mask."""

    boxes_px: Float32[ndarray, "n 4"]
    scores: Float32[ndarray, " n"]
    classes: Int64[ndarray, " n"]
    rows: Int64[ndarray, " n"]

    def take(self, chosen: Int64[ndarray, " m"]) -> Candidates:
        """Return the candidates at these places."""
        return Candidates(self.boxes_px[chosen], self.scores[chosen], self.classes[chosen], self.rows[chosen])

    def joined(self, other: Candidates) -> Candidates:
        """Return these candidates and then the others."""
        boxes_px, scores = np.concatenate([self.boxes_px, other.boxes_px]), np.concatenate([self.scores, other.scores])
        classes, rows = np.concatenate([self.classes, other.classes]), np.concatenate([self.rows, other.rows])
        return Candidates(boxes_px, scores, classes, rows)


def letterbox(
    rgb: UInt8[ndarray, "h w 3"], height_px: int, width_px: int, size_px: tuple[int, int] | None = None
) -> tuple[Float32[ndarray, "1 3 H W"], Letterbox]:
    """Scale an image to fit, centre it on grey, and convert it to [0, 1] with channels first.

    size_px: (height, width) in whose pixels the letterbox is stated, by default the image's own.
    """
    h, w = size_px or rgb.shape[:2]
    scale = min(height_px / h, width_px / w)
    inner_h, inner_w = max(1, round(h * scale)), max(1, round(w * scale))
    top, left = (height_px - inner_h) // 2, (width_px - inner_w) // 2
    canvas = np.full((height_px, width_px, 3), _PAD_VALUE, np.uint8)
    canvas[top : top + inner_h, left : left + inner_w] = (
        rgb
        if (inner_h, inner_w) == rgb.shape[:2]
        else cv2.resize(rgb, (inner_w, inner_h), interpolation=cv2.INTER_LINEAR)
    )
    tensor = np.ascontiguousarray(canvas.transpose(2, 0, 1)[None]).astype(np.float32) / np.float32(255.0)
    return tensor, Letterbox(inner_w / w, inner_h / h, left, top)


def stretched(
    rgb: UInt8[ndarray, "h w 3"], height_px: int, width_px: int, size_px: tuple[int, int], normalise: bool
) -> tuple[Float32[ndarray, "1 3 H W"], Letterbox]:
    """Scale an image to this size without keeping its proportions; to [0, 1], or normalised as ImageNet.

    Half-pixel bilinear interpolation of floats without antialiasing, as RF-DETR's own prediction.
    """
    unit = cv2.resize(rgb.astype(np.float32) / np.float32(255), (width_px, height_px), interpolation=cv2.INTER_LINEAR)
    values = (unit - MEAN) / STANDARD_DEVIATION if normalise else unit
    tensor = np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32)
    return tensor, Letterbox(width_px / size_px[1], height_px / size_px[0], 0, 0)


def candidates_of(reading: Reading, letterboxing: Letterbox, size_px: tuple[int, int], min_score: float) -> Candidates:
    """Return the candidates that reach min_score, clipped to an image of size_px (height, width)."""
    kept = np.flatnonzero(reading.scores >= min_score)
    rows = reading.rows[kept].astype(np.int64)
    boxes_px = boxes_in_image(reading.boxes[rows], letterboxing, size_px)
    return Candidates(boxes_px, reading.scores[kept], reading.classes[kept].astype(np.int64), rows)


def boxes_in_image(
    boxes: Float32[ndarray, "n 4"], letterboxing: Letterbox, size_px: tuple[int, int]
) -> Float32[ndarray, "n 4"]:
    """Return boxes of the network's image in an image of size_px (height, width), clipped to it."""
    offset = np.array([letterboxing.left_px, letterboxing.top_px] * 2, np.float32)
    scale = np.array([letterboxing.scale_x, letterboxing.scale_y] * 2, np.float32)
    limits = np.array([size_px[1], size_px[0]] * 2, np.float32)
    boxes_px: Float32[ndarray, "n 4"] = np.clip((boxes - offset) / scale, 0, limits).astype(np.float32)
    return boxes_px


def suppress(candidates: Candidates, max_iou: float, max_boxes: int, across_classes: bool) -> Candidates:
    """Return the best max_boxes after greedy non-maximum suppression, per class or across classes, best first."""
    if len(candidates.scores) == 0:
        return candidates
    boxes = candidates.boxes_px.astype(np.float64)
    boxes[:, 2:] -= boxes[:, :2]
    if not across_classes:
        # offset boxes by class, so that boxes of different classes never overlap
        boxes[:, :2] += (candidates.classes * (boxes.max() * 2 + 1.0))[:, None]
    order = cv2.dnn.NMSBoxes(boxes.tolist(), candidates.scores.tolist(), 0.0, max_iou)
    return candidates.take(np.asarray(order, np.int64).reshape(-1)[:max_boxes])


def mask_of(
    coefficients: Float32[ndarray, " k"],
    prototypes: Float32[ndarray, "k ph pw"],
    box_px: Float32[ndarray, "4"],
    letterboxing: Letterbox,
    sizes_px: tuple[tuple[int, int], tuple[int, int]],
) -> Bool[ndarray, "h w"]:
    """Return one object's mask in the image, False outside its box; sizes_px: (height, width) of image and network."""
    (height_px, width_px), (network_h, network_w) = sizes_px
    logits = np.tensordot(coefficients, prototypes, axes=1).astype(np.float32)
    rows_per_px, columns_per_px = logits.shape[0] / network_h, logits.shape[1] / network_w
    left, top = np.floor(box_px[:2]).astype(int)
    right, bottom = np.minimum(np.ceil(box_px[2:]).astype(int), (width_px, height_px))
    mask = np.zeros((height_px, width_px), np.bool_)
    if right <= left or bottom <= top:
        return mask
    # maps pixel centres of the box to cell centres of the prototype grid
    scale_x, scale_y = letterboxing.scale_x * columns_per_px, letterboxing.scale_y * rows_per_px
    to_grid = np.array(
        [
            [scale_x, 0.0, (left + 0.5) * scale_x + letterboxing.left_px * columns_per_px - 0.5],
            [0.0, scale_y, (top + 0.5) * scale_y + letterboxing.top_px * rows_per_px - 0.5],
        ]
    )
    inside = cv2.warpAffine(
        logits,
        to_grid,
        (int(right - left), int(bottom - top)),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    mask[top:bottom, left:right] = inside > 0.0
    return mask


def resized_mask(logits: Float32[ndarray, "mh mw"], size_px: tuple[int, int]) -> Bool[ndarray, "h w"]:
    """Return a mask of the whole stretched image in size_px (height, width); from 0 to 1 or as logits."""
    level = 0.5 if logits.min() >= 0.0 and logits.max() <= 1.0 else 0.0
    mask: Bool[ndarray, "h w"] = cv2.resize(logits, size_px[::-1], interpolation=cv2.INTER_LINEAR) > level
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class NetworkOutput:
    """Raw output for one image, before any threshold, with boxes in the network's pixels and scores from 0 to 1."""

    reading: Reading
    letterboxing: Letterbox
    size_px: tuple[int, int]
    network_size_px: tuple[int, int]

    def candidates(self, min_score: float) -> Candidates:
        """Return the candidates that reach min_score, unordered."""
        return candidates_of(self.reading, self.letterboxing, self.size_px, min_score)

    def peak(self, classes: Sequence[int]) -> Candidates:
        """Return the one box that has the best score of these classes, below every threshold too."""
        index = np.array([max(classes, key=lambda each: self.reading.peak_scores[each])])
        rows = self.reading.peak_rows[index]
        boxes_px = boxes_in_image(self.reading.boxes[rows], self.letterboxing, self.size_px)
        return Candidates(boxes_px, self.reading.peak_scores[index], index, rows)

    def masks(self, candidates: Candidates) -> list[Bool[ndarray, "h w"]]:
        """Return one mask per candidate; those of prototypes are False outside its box."""
        coefficients, masks = self.reading.coefficients, self.reading.masks
        if coefficients.shape[1] == 0:
            return [resized_mask(masks[row], self.size_px) for row in candidates.rows]
        sizes_px = (self.size_px, self.network_size_px)
        return [
            mask_of(coefficients[row], masks, box, self.letterboxing, sizes_px)
            for row, box in zip(candidates.rows, candidates.boxes_px, strict=True)
        ]


_TYPES: Final[dict[str, type[np.generic]]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_DEFAULT_SIDE_PX: Final = 640


@dataclass(frozen=True, slots=True)
class ImageInput:
    """The inputs of a network: one image [batch, 3, h, w], or with channels last, and for some the image's size."""

    image: str
    size: str | None
    kind: type[np.generic]
    size_kind: type[np.generic]
    batch: int
    has_channels_last: bool
    height_px: int
    width_px: int

    @classmethod
    def of(cls, model: OpenModel) -> ImageInput:
        """Return the inputs of a model. Raises ModelFileError for others than an image and its size."""
        ports = model.session.get_inputs()
        images = [port for port in ports if len(port.shape) == 4 and port.type in _TYPES]
        sizes = [port for port in ports if len(port.shape) == 2 and port.type in ("tensor(int64)", "tensor(int32)")]
        shape = images[0].shape if len(images) == 1 else []
        has_channels_last = len(shape) == 4 and shape[3] == 3 and shape[1] != 3
        is_colour = has_channels_last or (len(shape) == 4 and (shape[1] == 3 or not isinstance(shape[1], int)))
        if not is_colour or len(images) + len(sizes) != len(ports) or len(sizes) > 1:
            received = ", ".join(f"{port.name} {port.shape} {port.type}" for port in ports)
            raise ModelFileError(
                f"model {model.path}: expected one input [1, 3, height, width] in float32, float16 or uint8, "
                f"or that and the image's size [1, 2]; got {received}"
            )
        metadata = model.session.get_modelmeta().custom_metadata_map
        sides = shape[1:3] if has_channels_last else shape[2:]
        height_px, width_px = (
            side if isinstance(side, int) else stated_side_px(metadata, axis, _DEFAULT_SIDE_PX)
            for axis, side in enumerate(sides)
        )
        size_kind = np.int32 if sizes and sizes[0].type == "tensor(int32)" else np.int64
        batch = shape[0] if isinstance(shape[0], int) else 1
        size = sizes[0].name if sizes else None
        kind = _TYPES[images[0].type]
        return cls(
            image=images[0].name,
            size=size,
            kind=kind,
            size_kind=size_kind,
            batch=batch,
            has_channels_last=has_channels_last,
            height_px=height_px,
            width_px=width_px,
        )

    def feed(self, tensor: Float32[ndarray, "1 3 H W"]) -> dict[str, Any]:
        """Return the inputs for one image, which fills the batch."""
        values = tensor * 255 if self.kind is np.uint8 else tensor
        image = values.transpose(0, 2, 3, 1) if self.has_channels_last else values
        fed: dict[str, Any] = {self.image: np.repeat(image, self.batch, axis=0).astype(self.kind)}
        if self.size is not None:
            # boxes are then in the network's pixels
            fed[self.size] = np.array([[self.width_px, self.height_px]] * self.batch, self.size_kind)
        return fed


class DetectionNetwork:
    """A network from one image to boxes, scores by class and maybe masks, in any layout of `layouts`."""

    def __init__(self, model: OpenModel) -> None:
        """Run the model once to find the layout of its outputs. Raises ModelFileError."""
        self.path, self._session = model.path, model.session
        self._input = ImageInput.of(model)
        blank = np.zeros((1, 3, self._input.height_px, self._input.width_px), np.float32)
        outputs = run_once(model, self._input.feed(blank))
        names = tuple(str(port.name) for port in self._session.get_outputs())
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.layout = layout_of(Outputs(self.path, names, tuple(map(_first, outputs)), metadata))
        self._scale = ScoreScale(self.path)
        self._latest: tuple[Frame, NetworkOutput] | None = None

    def run(self, frame: Frame) -> NetworkOutput:
        """Return the network's output for a frame; the latest output is cached."""
        latest = self._latest
        if latest is None or latest[0] is not frame:
            latest = self._latest = frame, self._infer(frame)
        return latest[1]

    def _infer(self, frame: Frame) -> NetworkOutput:
        size_px = (frame.camera.height_px, frame.camera.width_px)
        network_size_px = (self._input.height_px, self._input.width_px)
        if self.layout.fit is ImageFit.LETTERBOX:
            tensor, letterboxing = letterbox(frame.sharpest_rgb, *network_size_px, size_px)
        else:
            is_normalised = self.layout.fit is ImageFit.NORMALISE
            tensor, letterboxing = stretched(frame.sharpest_rgb, *network_size_px, size_px, is_normalised)
        reading = self.layout.decode([_first(output) for output in self._session.run(None, self._input.feed(tensor))])
        scores, peak_scores = self._scale.to_unit(reading.scores), self._scale.to_unit(reading.peak_scores)
        reading = replace(reading, scores=scores, peak_scores=peak_scores)
        reading = replace(reading, boxes=in_pixels(reading, network_size_px, self.path))
        unknown = reading.classes[reading.scores > 0].max(initial=0)
        if unknown >= self.layout.classes:
            raise ModelFileError(
                f"model {self.path}: expected classes below {self.layout.classes}, which have names, got {unknown}; "
                f"state all names in {names_file(self.path).name} beside it, one per line"
            )
        return NetworkOutput(reading, letterboxing, size_px, network_size_px)


def _first(output: ndarray[Any, np.dtype[Any]]) -> ndarray[Any, np.dtype[Any]]:
    """Return the part of an output that belongs to the batch's first image."""
    return output[0] if output.ndim and len(output) else np.zeros(output.shape[1:], output.dtype)
