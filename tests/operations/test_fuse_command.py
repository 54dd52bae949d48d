"""`gausslite fuse` keeps its inputs, and fuses only maps of one world frame."""

from pathlib import Path

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.cli.main import main
from gausslite.codec.ply import read_world_frame, write_ply


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """Return two maps without a world frame."""
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    for path in paths:
        write_ply(path, plain_gaussians(np.linspace(0, 1, 30)))
    return paths


def fuse(*arguments: Path) -> int:
    return main(["fuse", *map(str, arguments[:-1]), "--out", str(arguments[-1])])


def test_an_output_that_is_an_input_is_refused(
    maps: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = maps[1].read_bytes()
    (tmp_path / "link.ply").symlink_to(maps[1])
    (tmp_path / "hard.ply").hardlink_to(maps[1])
    monkeypatch.chdir(tmp_path)
    for out in (maps[1], Path("b.ply"), tmp_path / "link.ply", tmp_path / "hard.ply", tmp_path / "x" / ".." / "b.ply"):
        assert fuse(*maps, out) == 2
        assert "expected a file that is not an input" in capsys.readouterr().err
    assert maps[1].read_bytes() == before


def test_maps_of_different_world_frames_are_refused(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gaussians = plain_gaussians(np.linspace(0, 1, 30))
    write_ply(maps[0], gaussians, "map")
    write_ply(maps[1], gaussians, "odom")
    assert fuse(*maps, tmp_path / "fused.ply") == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"expected one world frame, got 'map' in {maps[0]}, 'odom' in {maps[1]}; if the poses share" in line
    assert "map both with the same --set world-frame=NAME" in line
    assert not (tmp_path / "fused.ply").exists()


def test_the_fused_map_names_the_world_frame_of_its_maps(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fuse(*maps, tmp_path / "plain.ply") == 0
    assert f"no world frame named in {maps[0]}, {maps[1]}; assumed to be in one world" in capsys.readouterr().err
    assert read_world_frame(tmp_path / "plain.ply") == ""
    write_ply(maps[0], plain_gaussians(np.linspace(0, 1, 30)), "map")
    assert fuse(*maps, tmp_path / "fused.ply") == 0
    assert f"no world frame named in {maps[1]}; assumed to be in 'map'" in capsys.readouterr().err
    assert read_world_frame(tmp_path / "fused.ply") == "map"
    write_ply(maps[1], plain_gaussians(np.linspace(0, 1, 30)), "map")
    assert fuse(*maps, tmp_path / "fused.ply") == 0
    assert not capsys.readouterr().err


def test_a_results_folder_stands_for_its_map(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    maps[0].rename(tmp_path / "run" / "map.ply")
    assert fuse(tmp_path / "run", maps[1], tmp_path / "run" / "map.ply") == 2
    assert "expected a file that is not an input" in capsys.readouterr().err
    assert fuse(tmp_path / "run", maps[1], tmp_path / "fused.ply") == 0
    assert f"{tmp_path / 'run' / 'map.ply'} won " in capsys.readouterr().out


def test_the_same_file_twice_is_refused(maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "link.ply").symlink_to(maps[0])
    for same in (maps[0], tmp_path / "link.ply"):
        assert fuse(maps[0], maps[1], same, tmp_path / "fused.ply") == 2
        [line] = capsys.readouterr().err.splitlines()
        assert f"expected different files, got {maps[0]} and {same}" in line
    assert not (tmp_path / "fused.ply").exists()


def test_a_file_of_another_kind_is_not_replaced(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "groundtruth.txt"
    notes.write_text("1 0 0 0 0 0 0 1")
    assert fuse(*maps, notes) == 2
    assert "groundtruth.txt exists already and is not a map; choose another name" in capsys.readouterr().err
    assert fuse(*maps, tmp_path / "fused.spz") == 2
    assert "fused.spz: expected a name with the suffix .ply for a map" in capsys.readouterr().err
    assert not (tmp_path / "fused.spz").exists()
    assert notes.read_text() == "1 0 0 0 0 0 0 1"
