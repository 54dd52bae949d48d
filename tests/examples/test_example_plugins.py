"""The example packages: each is installed from its folder, as its user would, and `gausslite map` uses it."""

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pip_installed import install
from tiny_sequences import FEW_GAUSSIANS, write_tum

from gausslite import plugins
from gausslite.cli.main import main

pytest.importorskip("setuptools", reason="the examples are built with setuptools, which is not installed")
pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the installed examples."""
    folder = tmp_path_factory.mktemp("plugins") / "site"
    for example in ("colour_detector", "array_recording"):
        install(example, folder)
    return folder


@pytest.fixture(autouse=True)
def found(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let this process find the examples, as one that starts after their installation."""
    monkeypatch.syspath_prepend(installed)
    plugins._entry_points.cache_clear()
    yield
    plugins._entry_points.cache_clear()


def gausslite(*arguments: str | Path) -> int:
    return main([str(argument) for argument in arguments])


def write_red_cup(folder: Path) -> Path:
    """Write a TUM folder of a red cup, 1 m away, before a grey wall."""
    write_tum(folder)
    bgr, depth = np.full((48, 64, 3), 128, np.uint8), np.full((48, 64), 10_000, np.uint16)
    bgr[18:30, 26:38], depth[18:30, 26:38] = (30, 25, 190), 5_000
    for kind, image in (("rgb", bgr), ("depth", depth)):
        for path in (folder / kind).iterdir():
            assert cv2.imwrite(str(path), image)
    return folder


def test_a_detector_of_another_package_finds_the_target(tmp_path: Path) -> None:
    sequence, out, things = write_red_cup(tmp_path / "fr1_cup"), tmp_path / "out", tmp_path / "things.colours"
    things.write_text("cup 190 25 30\nball 20 20 200\n")
    command = ("map", sequence, *FEW_GAUSSIANS, "--task", "Pick up the cup", "--detector", things, "--out", out)
    assert gausslite(*command) == 0
    report = json.loads((out / "report.json").read_text())
    assert [(found["noun"], found["confirmed_objects"]) for found in report["nouns"]] == [("cup", 1)]
    assert report["active_gaussians"] > 0


def test_a_recording_of_another_packages_format_is_mapped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (3, 24, 32, 3), dtype=np.uint8)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.arange(3) / 20
    arrays = {
        "rgb": rgb,
        "depth_m": np.full((3, 24, 32), 2.0, np.float32),
        "T_world_camera": poses,
        "times_ns": np.arange(3) * 10**8,
    }
    np.savez(tmp_path / "run.npz", camera=(30.0, 30.0, 16.0, 12.0), **arrays)
    for name, address in (("by_suffix", tmp_path / "run.npz"), ("by_name", f"npz:{tmp_path / 'run.npz'}")):
        assert gausslite("map", address, *FEW_GAUSSIANS, "--out", tmp_path / name) == 0
        assert json.loads((tmp_path / name / "report.json").read_text())["frames"] == 3
    (tmp_path / "broken.npz").write_bytes(b"PK")
    assert gausslite("map", tmp_path / "broken.npz", "--out", tmp_path / "broken") == 2
    assert "broken.npz: expected the arrays rgb, depth_m" in capsys.readouterr().err.splitlines()[-1]


def test_a_file_that_no_reader_knows_is_refused_by_the_default_reader(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("no model")
    command = ("map", write_tum(tmp_path / "fr1_cup"), "--task", "Pick up the cup", "--out", tmp_path / "out")
    assert gausslite(*command, "--detector", tmp_path / "notes.txt") == 2
    assert "notes.txt: expected a readable ONNX model, got" in capsys.readouterr().err.splitlines()[-1]
    assert gausslite(*command) == 2
    advice = capsys.readouterr().err.splitlines()[-1]
    assert "expected --detector FILE.onnx" in advice
    assert "write FILE.colours" in advice
