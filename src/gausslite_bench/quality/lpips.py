"""LPIPS, a perceptual image distance (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features").

The network is AlexNet up to its fifth convolution. The user provides files with its weights and those of the five
linear heads, under the names used by torchvision and by the LPIPS authors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float32, Shaped
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, ModelFileError, ShapeError

if TYPE_CHECKING:
    from torch import Tensor

# index in torchvision's `features`, channels out and in, kernel, stride, padding; pooled before the second and third
_LAYERS: Final = (
    (0, 64, 3, 11, 4, 2),
    (3, 192, 64, 5, 1, 2),
    (6, 384, 192, 3, 1, 1),
    (8, 256, 384, 3, 1, 1),
    (10, 256, 256, 3, 1, 1),
)
_POOLED_BEFORE: Final = (1, 2)
_SHIFT: Final = (-0.030, -0.088, -0.188)
_SCALE: Final = (0.458, 0.448, 0.450)
_MIN_SIDE_PX = 64
_EPSILON = 1e-10


class Lpips:
    """A PerceptualDistance on the CPU; its weights take about 10 MB."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        """Weights by name: features.N.weight, features.N.bias and linK.model.1.weight. Raises ModelFileError."""
        expected = _expected_shapes()
        missing = [name for name in expected if name not in weights]
        if missing:
            raise ModelFileError(f"LPIPS weights: expected {', '.join(expected)}; missing are {', '.join(missing)}")
        for name, shape in expected.items():
            received = tuple(weights[name].shape)
            if received != shape:
                raise ModelFileError(f"LPIPS weights: {name}: expected shape {shape}, got {received}")
        self._weights = {name: weights[name].detach().float() for name in expected}

    def distance_map(self, a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        """Return LPIPS per pixel: the sum of the layers' distances, resized to the image; its mean is the usual LPIPS.

        Images are uint8, or floating in [0, 1], with sides of at least 64 pixels. Raises ShapeError.
        """
        import torch
        from torch.nn import functional

        if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3 or min(a.shape[:2]) < _MIN_SIDE_PX:
            sides = f"sides of at least {_MIN_SIDE_PX}"
            raise ShapeError(f"LPIPS: expected two images (h, w, 3) of one shape, {sides}, got {a.shape} and {b.shape}")
        height, width = a.shape[:2]
        total = torch.zeros(1, 1, height, width)
        with torch.inference_mode():
            for k, (one, two) in enumerate(zip(self._features(a), self._features(b), strict=True)):
                head = self._weights[f"lin{k}.model.1.weight"]
                distance = functional.conv2d((one - two) ** 2, head)
                total += functional.interpolate(distance, (height, width), mode="bilinear", align_corners=False)
        distances: Float32[ndarray, "h w"] = total[0, 0].numpy()
        return distances

    def _features(self, image: Shaped[ndarray, "h w 3"]) -> list[Tensor]:
        """Return the five ReLU layers, with unit-length channels per pixel."""
        import torch
        from torch.nn import functional

        unit = image / np.float32(255.0) if image.dtype == np.uint8 else image.astype(np.float32)
        normal = (2.0 * unit - 1.0 - np.array(_SHIFT)) / np.array(_SCALE)
        layer = torch.from_numpy(np.ascontiguousarray(normal.transpose(2, 0, 1)[None], np.float32))
        layers = []
        for k, (index, _, _, _, stride, padding) in enumerate(_LAYERS):
            if k in _POOLED_BEFORE:
                layer = functional.max_pool2d(layer, 3, 2)
            weight, bias = (self._weights[f"features.{index}.{part}"] for part in ("weight", "bias"))
            layer = functional.relu(functional.conv2d(layer, weight, bias, stride, padding))
            length = torch.sqrt((layer**2).sum(dim=1, keepdim=True))
            layers.append(layer / (length + _EPSILON))
        return layers


def load_lpips(paths: Sequence[Path]) -> Lpips:
    """Return LPIPS from one file with all weights, or from several files (AlexNet's and the linear heads').

    Raises ModelFileError naming the file, and InvalidInputError if torch is not installed.
    """
    weights: dict[str, Tensor] = {}
    for path in paths:
        weights |= _read(path)
    return Lpips(weights)


def _read(path: Path) -> dict[str, Tensor]:
    try:
        import torch
    except ImportError:
        raise InvalidInputError(
            "--lpips-weights: needs torch; install it with: pip install 'gausslite[reference]'"
        ) from None
    if not path.is_file():
        raise ModelFileError(f"{path}: expected a file of LPIPS weights, got no file")
    try:
        # the file is untrusted: load tensors only, no code
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types of errors for foreign files
        raise ModelFileError(f"{path}: expected tensors saved by torch, got {type(error).__name__}") from None
    if not isinstance(stored, Mapping):
        raise ModelFileError(f"{path}: expected tensors by name, got {type(stored).__name__}")
    return {str(name): value for name, value in stored.items() if isinstance(value, torch.Tensor)}


def _expected_shapes() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for k, (index, out, channels, kernel, _, _) in enumerate(_LAYERS):
        shapes[f"features.{index}.weight"] = (out, channels, kernel, kernel)
        shapes[f"features.{index}.bias"] = (out,)
        shapes[f"lin{k}.model.1.weight"] = (1, out, 1, 1)
    return shapes
