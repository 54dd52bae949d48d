"""Run a YOLO or FastSAM network: an image in, candidate boxes by class index out, with masks if it has prototypes."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite.perception.models.model_file import OpenModel, run_once
from gausslite.perception.yolo_decode import MASK_COEFFICIENTS, Candidates, Letterbox, decode, letterbox, mask_of

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
        received = ", ".join(f"{each.name} {each.shape} {each.type}" for each in inputs)
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
    """Return the indices of boxes and prototypes among the outputs; None without masks.

    classes 0 accepts any number of classes, but only with masks.
    """
    if len(outputs) == 1 and classes and outputs[0].ndim == 3 and outputs[0].shape[:2] == (1, 4 + classes):
        return 0, None
    received = " and ".join(str(list(each.shape)) for each in outputs)
    min_rows = 4 + max(classes, 1) + MASK_COEFFICIENTS
    rows = f"{min_rows}, A] and [1, 32, h, w], or [1, {4 + classes}, A]" if classes else "4+c+32, A] and [1, 32, h, w]"
    boxes = [
        i for i, each in enumerate(outputs)
        if each.ndim == 3 and (each.shape[1] == min_rows if classes else each.shape[1] >= min_rows) and len(each) == 1
    ]  # fmt: skip
    prototypes = [i for i, each in enumerate(outputs) if each.ndim == 4 and each.shape[:2] == (1, MASK_COEFFICIENTS)]
    if len(boxes) != 1 or len(prototypes) != 1:
        raise ModelFileError(f"model {path}: expected a YOLO network with outputs [1, {rows}, got {received}")
    return boxes[0], prototypes[0]
