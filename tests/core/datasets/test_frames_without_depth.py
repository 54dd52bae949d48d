"""Frames without a depth reading are neither mapped nor scored, and the summary reports them."""

import json
from pathlib import Path

import pytest
from tiny_sequences import write_depth, write_seven_scenes

from gausslite.cli.main import main

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


def without_depth(folder: Path, *numbers: int) -> Path:
    """Return a sequence of frames 0, 4 and 8 without depth in these frames."""
    write_seven_scenes(folder)
    for number in numbers:
        write_depth(folder / f"frame-{number:06d}.depth.png", value=0)
    return folder


def map_uniformly(sequence: Path, out: Path) -> int:
    return main(["map", str(sequence), "--policy", "uniform", "--max-gaussians", "150", "--out", str(out)])


def test_the_summary_reports_skipped_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert map_uniformly(without_depth(tmp_path / "one", 4), tmp_path / "out") == 0
    assert capsys.readouterr().out.startswith("2 frames (skipped: 1 without depth) at ")
    assert map_uniformly(without_depth(tmp_path / "none"), tmp_path / "other") == 0
    assert capsys.readouterr().out.startswith("3 frames at ")


def test_a_sequence_without_any_depth_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert map_uniformly(without_depth(tmp_path / "none", 0, 4, 8), tmp_path / "out") == 2
    assert "none: expected frames with depth, got none in 3" in capsys.readouterr().err
    assert not (tmp_path / "out" / "map.ply").exists()


def test_frames_without_depth_are_not_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert map_uniformly(without_depth(tmp_path / "one", 4), tmp_path / "out") == 0
    capsys.readouterr()
    options = ["--set", "register-depth=none", "--json"]
    score = ["eval", str(tmp_path / "out" / "map.ply")]
    assert main([*score, str(tmp_path / "one"), *options]) == 0
    assert json.loads(capsys.readouterr().out)["n_views"] == 2
    assert main([*score, str(without_depth(tmp_path / "all", 0, 4, 8)), *options]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "all: expected at least one frame with depth, got none" in line


def test_the_summary_reports_objects_not_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    small = ["--size", "64x48", "--max-gaussians", "200", "--iterations", "1"]
    assert main(["map", "sim:home?frames=1", "--task", "Find the unicorn", *small, "--out", str(tmp_path)]) == 3
    assert (tmp_path / "map.ply").is_file()
    output = capsys.readouterr().out
    assert "\n  no region matches 'unicorn'; the regions are " in output
    *_, note, outcome = output.splitlines()
    assert note == "  found nothing of the task in these frames"
    assert outcome.startswith("found: no unicorn; 1 training view: ")
