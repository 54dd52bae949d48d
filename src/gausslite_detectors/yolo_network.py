"""Run a YOLO or FastSAM network: an image in, candidate boxes by class index out, with masks if it has prototypes."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite_detectors.model_file import OpenModel, run_once

MASK_COEFFICIENTS = 32
_PAD_VALUE = 114


@dataclass(frozen=True, slots=True)
class Letterbox:
    """Scale and padding of an image: x_network = x_image · scale_x + left_px, and the same for y."""

    scale_x: float
    scale_y: float
    left_px: int
    top_px: int


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Boxes (left, top, right, bottom) in image pixels with their best class, and k mask coefficients (0 or 32)."""

    boxes_px: Float32[ndarray, "n 4"]
    scores: Float32[ndarray, " n"]
    classes: Int64[ndarray, " n"]
    coefficients: Float32[ndarray, "n k"]

    def take(self, rows: Int64[ndarray, " m"]) -> Candidates:
        """Return the candidates of these rows."""
        return Candidates(self.boxes_px[rows], self.scores[rows], self.classes[rows], self.coefficients[rows])


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


def decode(
    output: Float32[ndarray, "rows a"],
    classes: int,
    letterboxing: Letterbox,
    size_px: tuple[int, int],
    min_score: float,
) -> Candidates:
    """Return the anchors whose best class reaches min_score, clipped to an image of size_px (height, width).

    The rows of output are centre x, y, width, height, the scores of the classes, and the mask coefficients.
    """
    class_scores = output[4 : 4 + classes]
    best = class_scores.argmax(axis=0)
    scores = class_scores[best, np.arange(output.shape[1])]
    kept = np.flatnonzero(scores >= min_score)
    centre_x, centre_y, width, height = output[:4, kept]
    height_px, width_px = size_px
    boxes = np.stack(
        [
            np.clip((centre_x - width / 2 - letterboxing.left_px) / letterboxing.scale_x, 0, width_px),
            np.clip((centre_y - height / 2 - letterboxing.top_px) / letterboxing.scale_y, 0, height_px),
            np.clip((centre_x + width / 2 - letterboxing.left_px) / letterboxing.scale_x, 0, width_px),
            np.clip((centre_y + height / 2 - letterboxing.top_px) / letterboxing.scale_y, 0, height_px),
        ],
        axis=1,
    ).astype(np.float32)
    return Candidates(
        boxes,
        scores[kept].astype(np.float32),
        best[kept].astype(np.int64),
        np.ascontiguousarray(output[4 + classes :, kept].T).astype(np.float32),
    )


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


_DEFAULT_SIDE_PX: Final = 640


@dataclass(frozen=True, slots=True, eq=False)
class NetworkOutput:
    """Raw output for one image, before any threshold. prototypes: of the masks; k is 0 in a network without masks."""

    output: Float32[ndarray, "rows a"]
    prototypes: Float32[ndarray, "k ph pw"]
    letterboxing: Letterbox
    size_px: tuple[int, int]
    network_size_px: tuple[int, int]

    def candidates(self, min_score: float) -> Candidates:
        """Return the boxes whose best class reaches min_score, unordered."""
        classes = len(self.output) - 4 - len(self.prototypes)
        return decode(self.output, classes, self.letterboxing, self.size_px, min_score)

    def masks(self, candidates: Candidates) -> list[Bool[ndarray, "h w"]]:
        """Return one mask per candidate, False outside its box; empty masks in a network without masks."""
        sizes_px = (self.size_px, self.network_size_px)
        return [
            mask_of(coefficients, self.prototypes, box, self.letterboxing, sizes_px)
            for coefficients, box in zip(candidates.coefficients, candidates.boxes_px, strict=True)
        ]


class YoloNetwork:
    """A network from one image to [1, 4+c+32, A] (boxes, c class scores, mask coefficients) and [1, 32, h, w].

    A network without masks has only [1, 4+c, A], and class names, which state c.
    """

    def __init__(self, model: OpenModel) -> None:
        """Run the model once to check its outputs. Raises ModelFileError."""
        self.path, self._session = model.path, model.session
        self._input, self._height_px, self._width_px = _input_of(model.path, self._session)
        blank = np.zeros((1, 3, self._height_px, self._width_px), np.float32)
        outputs = run_once(model, {self._input: blank})
        self.names = class_names(self._session)
        self._boxes_index, self._prototypes_index = _output_order(model.path, outputs, len(self.names))
        rows = int(outputs[self._boxes_index].shape[1])
        self.classes = rows - 4 - (MASK_COEFFICIENTS if self.has_masks else 0)
        self._latest: tuple[Frame, NetworkOutput] | None = None

    @property
    def has_masks(self) -> bool:
        """True if the network also returns masks."""
        return self._prototypes_index is not None

    def run(self, frame: Frame) -> NetworkOutput:
        """Return the network's output for a frame; the latest output is cached."""
        latest = self._latest
        if latest is None or latest[0] is not frame:
            latest = self._latest = frame, self._infer(frame)
        return latest[1]

    def _infer(self, frame: Frame) -> NetworkOutput:
        size_px = (frame.camera.height_px, frame.camera.width_px)
        tensor, letterboxing = letterbox(frame.sharpest_rgb, self._height_px, self._width_px, size_px)
        outputs = self._session.run(None, {self._input: tensor})
        network_size_px = (self._height_px, self._width_px)
        index = self._prototypes_index
        prototypes = np.zeros((0, 1, 1), np.float32) if index is None else outputs[index][0]
        return NetworkOutput(outputs[self._boxes_index][0], prototypes, letterboxing, size_px, network_size_px)


def _input_of(path: Path, session: Any) -> tuple[str, int, int]:
    inputs = session.get_inputs()
    shape = inputs[0].shape
    if len(inputs) != 1 or len(shape) != 4 or shape[1] not in (3, None) or inputs[0].type != "tensor(float)":
        received = ", ".join(f"{port.name} {port.shape} {port.type}" for port in inputs)
        raise ModelFileError(f"model {path}: expected one float input [1, 3, height, width], got {received}")
    height, width = (side if isinstance(side, int) else _DEFAULT_SIDE_PX for side in shape[2:])
    return str(inputs[0].name), height, width


def class_names(session: Any) -> tuple[str, ...]:
    """Return the class names in the file's metadata; empty if they are missing or invalid."""
    text = session.get_modelmeta().custom_metadata_map.get("names", "")
    try:
        names = ast.literal_eval(text)
        return tuple(str(names[index]) for index in range(len(names)))
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        return ()


def _output_order(path: Path, outputs: list[Float32[ndarray, "..."]], classes: int) -> tuple[int, int | None]:
    """Return which outputs are boxes and prototypes; None without masks. classes 0: any number, only with masks."""
    if len(outputs) == 1 and classes and outputs[0].ndim == 3 and outputs[0].shape[:2] == (1, 4 + classes):
        return 0, None
    received = " and ".join(str(list(output.shape)) for output in outputs)
    min_rows = 4 + max(classes, 1) + MASK_COEFFICIENTS
    rows = f"{min_rows}, A] and [1, 32, h, w], or [1, {4 + classes}, A]" if classes else "4+c+32, A] and [1, 32, h, w]"
    shapes = [output.shape for output in outputs]
    boxes = [
        index for index, shape in enumerate(shapes)
        if len(shape) == 3 and shape[0] == 1 and (shape[1] == min_rows if classes else shape[1] >= min_rows)
    ]  # fmt: skip
    prototypes = [
        index for index, shape in enumerate(shapes) if len(shape) == 4 and shape[:2] == (1, MASK_COEFFICIENTS)
    ]
    if len(boxes) != 1 or len(prototypes) != 1:
        raise ModelFileError(f"model {path}: expected a YOLO network with outputs [1, {rows}, got {received}")
    return boxes[0], prototypes[0]
