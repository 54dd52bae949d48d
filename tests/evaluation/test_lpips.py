"""LPIPS: which pixels are compared, in which range, and what is said of a wrong file."""

from pathlib import Path

import numpy as np
import pytest

from gausslite.domain.errors import ModelFileError, ShapeError
from gausslite_detectors.model_file import open_model
from gausslite_evaluation.lpips import Lpips, load_lpips

onnx = pytest.importorskip("onnx", reason="the test's networks are built with onnx, which is not installed")


def write_network(path: Path, inputs: tuple[str, ...] = ("one", "two")) -> Path:
    """Write a network whose distance is the mean absolute difference of its first and last input."""
    nodes = [
        onnx.helper.make_node("Sub", [inputs[0], inputs[-1]], ["difference"]),
        onnx.helper.make_node("Abs", ["difference"], ["absolute"]),
        onnx.helper.make_node("ReduceMean", ["absolute"], ["distance"], axes=[1, 2, 3], keepdims=1),
    ]
    ports = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", 3, "h", "w"]) for name in inputs]
    result = onnx.helper.make_tensor_value_info("distance", onnx.TensorProto.FLOAT, ["n", 1, 1, 1])
    graph = onnx.helper.make_graph(nodes, "tiny", ports, [result])
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8), str(path))
    return path


@pytest.fixture
def difference(tmp_path: Path) -> Lpips:
    return Lpips(open_model(write_network(tmp_path / "difference.onnx")))


@pytest.fixture(scope="module")
def lpips(shared_dir: Path) -> Lpips:
    return load_lpips(shared_dir / "models" / "lpips_squeeze.onnx")


def images(height: int = 90, width: int = 120) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return tuple(rng.integers(0, 256, (height, width, 3), np.uint8) for _ in range(2))


def test_colours_from_0_to_255_or_1_become_minus_1_to_1(difference: Lpips) -> None:
    black, white = np.zeros((64, 64, 3), np.uint8), np.full((64, 64, 3), 255, np.uint8)
    assert difference.distance(black, white) == pytest.approx(2.0)
    assert difference.distance(black, np.full((64, 64, 3), 0.5)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("region", "box"),
    [
        ((slice(5, 85), slice(20, 110)), (slice(5, 85), slice(20, 110))),
        ((slice(0, 4), slice(110, 120)), (slice(0, 64), slice(56, 120))),
        ((slice(40, 50), slice(60, 62)), (slice(13, 77), slice(29, 93))),
    ],
    ids=["large", "in a corner", "small"],
)
def test_a_region_counts_only_its_pixels_in_a_box_of_at_least_64(
    difference: Lpips, region: tuple[slice, slice], box: tuple[slice, slice]
) -> None:
    a, b = images()
    mask = np.zeros(a.shape[:2], np.bool_)
    mask[region] = True
    mask[region[0].start, region[1].start + 1] = False
    inside = np.abs(a.astype(float) - b)[mask].sum() / 127.5
    assert difference.distance(a, b, mask) == pytest.approx(inside / a[box].size, rel=1e-4)


def test_small_images_are_refused(difference: Lpips) -> None:
    a, b = images(63, 80)
    with pytest.raises(ShapeError, match=r"LPIPS \(SqueezeNet\): expected two images .* sides of at least 64"):
        difference.distance(a, b)


def test_a_wrong_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"none\.onnx: expected an ONNX file, found nothing"):
        load_lpips(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ModelFileError, match=r"text\.onnx: expected a readable ONNX model"):
        load_lpips(tmp_path / "text.onnx")
    with pytest.raises(ModelFileError, match=r"single\.onnx: .* two images as inputs, got 1"):
        load_lpips(write_network(tmp_path / "single.onnx", ("image",)))
    with pytest.raises(ModelFileError, match=r"other\.onnx: expected LPIPS \(SqueezeNet\) .* got 0\.1"):
        load_lpips(write_network(tmp_path / "other.onnx"))


def test_the_distance_is_0_for_equal_images_and_grows_with_noise(lpips: Lpips) -> None:
    a = np.random.default_rng(0).random((70, 90, 1)).repeat(3, axis=2) * 0.1 + 0.45
    noise = np.random.default_rng(1).normal(size=a.shape)
    distances = [lpips.distance(np.clip(a + sigma * noise, 0, 1), a) for sigma in (0.0, 0.05, 0.2)]
    assert distances[0] == 0.0
    assert 0.01 < distances[1] < distances[2] < 1.5
