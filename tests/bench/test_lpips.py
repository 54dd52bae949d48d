"""LPIPS with random weights against a computation in numpy, and invalid weight files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gausslite.domain.errors import ModelFileError
from gausslite_bench.quality.lpips import Lpips, load_lpips

torch = pytest.importorskip("torch", reason="LPIPS needs torch, which is not installed")

CONVOLUTIONS = (
    (0, 64, 3, 11, 4, 2),
    (3, 192, 64, 5, 1, 2),
    (6, 384, 192, 3, 1, 1),
    (8, 256, 384, 3, 1, 1),
    (10, 256, 256, 3, 1, 1),
)


@pytest.fixture(scope="module")
def weights() -> dict:
    rng = np.random.default_rng(0)
    made = {}
    for k, (index, out, channels, size, _, _) in enumerate(CONVOLUTIONS):
        spread = (channels * size * size) ** -0.5
        made[f"features.{index}.weight"] = torch.from_numpy(
            rng.normal(0, spread, (out, channels, size, size)).astype(np.float32)
        )
        made[f"features.{index}.bias"] = torch.from_numpy(rng.normal(0, 0.1, out).astype(np.float32))
        made[f"lin{k}.model.1.weight"] = torch.from_numpy(rng.random((1, out, 1, 1)).astype(np.float32))
    return made


def images(height: int = 67, width: int = 80) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return tuple(rng.integers(0, 256, (height, width, 3), np.uint8) for _ in range(2))


def windows(layer: np.ndarray, size: int, stride: int) -> np.ndarray:
    return np.lib.stride_tricks.sliding_window_view(layer, (size, size), axis=(1, 2))[:, ::stride, ::stride]


def numpy_layers(image: np.ndarray, weights: dict) -> list[np.ndarray]:
    layer = (image / 127.5 - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    layer, found = layer.transpose(2, 0, 1), []
    for k, (index, _, _, size, stride, margin) in enumerate(CONVOLUTIONS):
        if k in (1, 2):
            layer = windows(layer, 3, 2).max(axis=(3, 4))
        padded = np.pad(layer, ((0, 0), (margin, margin), (margin, margin)))
        kernel, bias = (weights[f"features.{index}.{part}"].numpy() for part in ("weight", "bias"))
        layer = np.einsum("chwij,ocij->ohw", windows(padded, size, stride), kernel, optimize=True) + bias[:, None, None]
        layer = np.maximum(layer, 0)
        found.append(layer / (np.sqrt((layer**2).sum(axis=0)) + 1e-10))
    return found


def enlarged(image: np.ndarray, height: int, width: int) -> np.ndarray:
    rows, columns = (
        np.clip((np.arange(size) + 0.5) * side / size - 0.5, 0, side - 1)
        for size, side in ((height, image.shape[0]), (width, image.shape[1]))
    )
    along = np.stack([np.interp(columns, np.arange(image.shape[1]), line) for line in image])
    return np.stack([np.interp(rows, np.arange(image.shape[0]), line) for line in along.T], axis=1)


def test_the_distance_equals_a_computation_in_numpy(weights: dict) -> None:
    a, b = images()
    expected = np.zeros(a.shape[:2])
    for k, (one, two) in enumerate(zip(numpy_layers(a, weights), numpy_layers(b, weights), strict=True)):
        head = weights[f"lin{k}.model.1.weight"].numpy().ravel()
        expected += enlarged(np.tensordot(head, (one - two) ** 2, axes=1), *a.shape[:2])
    np.testing.assert_allclose(Lpips(weights).distance_map(a, b), expected, rtol=2e-3, atol=1e-4)


def test_a_wrong_file_is_named(weights: dict, tmp_path: Path) -> None:
    (tmp_path / "text.pth").write_text("no tensors")
    with pytest.raises(ModelFileError, match=r"text\.pth: expected tensors saved by torch"):
        load_lpips([tmp_path / "text.pth"])
    with pytest.raises(ModelFileError, match=r"none\.pth: expected a file"):
        load_lpips([tmp_path / "none.pth"])
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(ModelFileError, match=r"list\.pth: expected tensors by name, got list"):
        load_lpips([tmp_path / "list.pth"])
    with pytest.raises(ModelFileError, match=r"features\.3\.bias: expected shape \(192,\), got \(7,\)"):
        Lpips(weights | {"features.3.bias": torch.zeros(7)})
