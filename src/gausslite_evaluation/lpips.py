"""LPIPS (SqueezeNet), a perceptual image distance (Zhang et al. 2018, arXiv:1801.03924).

The user provides the network as an ONNX file: two images (n, 3, h, w) in [-1, 1], RGB, to one distance each.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float32, Shaped
from numpy import ndarray

from gausslite.domain.errors import ModelFileError, ShapeError

if TYPE_CHECKING:
    from gausslite_detectors.model_file import OpenModel

NAME: Final = "LPIPS (SqueezeNet)"
LPIPS_HELP: Final = f"ONNX file of {NAME}, which is scored too (default: not computed)"
_MIN_SIDE_PX: Final = 64
"""The network's poolings leave nothing of images below 17 pixels, and the runtime then ends the process."""
_PROBE_DISTANCE: Final = 0.4474
"""The distance of `_probe_images`; for colours in [0, 1] or in another order it differs by more than 1 %."""


class Lpips:
    """The distance of two images, 0 for equal ones."""

    def __init__(self, model: OpenModel) -> None:
        self._model = model
        self._names = [entry.name for entry in model.session.get_inputs()]

    def distance(
        self, a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"], mask: Bool[ndarray, "h w"] | None = None
    ) -> float:
        """Return the distance; with a mask, that of the bounding box of its true pixels, with b outside them in both.

        The box has sides of at least 64 pixels. Images are uint8, or floating in [0, 1]. Raises ShapeError if they are
        smaller or differ in shape, and ModelFileError if the network fails.
        """
        if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3 or min(a.shape[:2]) < _MIN_SIDE_PX:
            sides = f"sides of at least {_MIN_SIDE_PX}"
            raise ShapeError(
                f"{NAME}: expected two images (h, w, 3) of one shape, {sides}, got {a.shape} and {b.shape}"
            )
        first, second = _as_input(a), _as_input(b)
        if mask is not None:
            rows, columns = _interval(np.any(mask, axis=1)), _interval(np.any(mask, axis=0))
            first = np.where(mask, first, second)[..., rows, columns]
            second = second[..., rows, columns]
        from gausslite_detectors.model_file import run_once

        outputs = run_once(self._model, dict(zip(self._names, (first, second), strict=True)))
        return float(np.mean(outputs[0]))


def load_lpips(path: Path, threads: int | None = None) -> Lpips:
    """Return LPIPS of a file, checked on two known images. Raises ModelFileError, which names the file."""
    from gausslite_detectors.model_file import open_model

    model = open_model(path, threads)
    if (count := len(model.session.get_inputs())) != 2:
        raise ModelFileError(f"model {path}: expected {NAME} with two images as inputs, got {count}")
    distance = Lpips(model).distance(*_probe_images())
    if not abs(distance - _PROBE_DISTANCE) < 0.005 * _PROBE_DISTANCE:
        raise ModelFileError(
            f"model {path}: expected {NAME} 0.1 of images in [-1, 1], which is {_PROBE_DISTANCE} for two known images, "
            f"got {distance:.4g}"
        )
    return Lpips(model)


def _probe_images() -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w 3"]]:
    """Return a coloured ramp, and the same with stripes."""
    ramp = np.linspace(0.0, 1.0, _MIN_SIDE_PX, dtype=np.float32)
    rows, columns = np.meshgrid(ramp, ramp, indexing="ij")
    image = np.stack([rows, columns, 1.0 - rows], axis=2)
    striped = image.copy()
    striped[:, ::8] = 1.0 - striped[:, ::8]
    return image, striped


def _as_input(image: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "1 3 h w"]:
    unit = image / np.float32(255.0) if image.dtype == np.uint8 else image.astype(np.float32)
    return np.ascontiguousarray((2.0 * unit - 1.0).transpose(2, 0, 1)[None], np.float32)


def _interval(is_inside: Bool[ndarray, " n"]) -> slice:
    """Return the interval from the first to the last true value, widened to the least side if it is shorter."""
    inside = np.flatnonzero(is_inside)
    first, end = int(inside[0]), int(inside[-1]) + 1
    length = max(end - first, _MIN_SIDE_PX)
    start = min(max((first + end - length) // 2, 0), is_inside.size - length)
    return slice(start, start + length)
