"""Bags give the same frames as the folder that they were made from, in every format of ROS 1 and ROS 2."""

import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from robot_bag import load_write_bag
from tum_recording import write_home

import gausslite as gl
from gausslite.datasets.open import open_source

pytest.importorskip("rosbags", reason="bags need the extra ros")
TOOL = Path(__file__).resolve().parents[2] / "tools" / "write_bag.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_home(tmp_path_factory.mktemp("bags") / "home")


def run_tool(folder: Path, bag: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(TOOL), str(folder), str(bag)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", ["b.bag", "b", "b.mcap"])
def test_a_bag_has_the_frames_of_its_folder(tmp_path: Path, folder: Path, name: str, compressed: bool) -> None:
    load_write_bag().write_tum_bag(folder, tmp_path / name, compressed)
    expected, bag = open_source(str(folder)), open_source(str(tmp_path / name))
    assert bag.camera == expected.camera
    assert list(bag.indices()) == list(expected.indices())
    assert bag.up_axis == expected.up_axis
    np.testing.assert_array_equal(bag.trajectory().times_s, expected.trajectory().times_s)
    for i in range(len(expected)):
        frame, other = bag.frame(i), expected.frame(i)
        assert (frame.index, frame.capture_time_ns) == (other.index, other.capture_time_ns)
        assert frame.rgb.tobytes() == other.rgb.tobytes()
        assert frame.depth_m.tobytes() == other.depth_m.tobytes()
        assert frame.T_world_camera.tobytes() == other.T_world_camera.tobytes()


def test_a_folder_without_a_camera_file_has_the_published_camera_of_its_name(tmp_path: Path, folder: Path) -> None:
    named = tmp_path / "rgbd_dataset_freiburg1_home"
    shutil.copytree(folder, named)
    (named / "cam_params.json").unlink()
    assert run_tool(named, tmp_path / "b.mcap").returncode == 0
    expected, bag = open_source(str(named)), open_source(str(tmp_path / "b.mcap"))
    assert (bag.camera, bag.lens) == (expected.camera, expected.lens)
    assert bag.frame(0).depth_m.tobytes() == expected.frame(0).depth_m.tobytes()


def test_a_folder_of_an_unknown_camera_is_one_line(tmp_path: Path, folder: Path) -> None:
    shutil.copytree(folder, tmp_path / "kitchen")
    (tmp_path / "kitchen" / "cam_params.json").unlink()
    done = run_tool(tmp_path / "kitchen", tmp_path / "b.mcap")
    (line,) = done.stderr.splitlines()
    assert "the camera is unknown" in line
    assert done.returncode == 1


@pytest.mark.parametrize("name", ["b.bag", "b", "b.mcap"])
def test_a_bag_gives_the_map_of_its_folder_bit_for_bit(tmp_path: Path, folder: Path, name: str) -> None:
    load_write_bag().write_tum_bag(folder, tmp_path / name)
    settings = gl.MissionSettings(max_gaussians=2000, iterations=2)
    maps = [gl.map_sequence(gl.open_sequence(path), settings=settings).gaussians for path in (folder, tmp_path / name)]
    columns = [field.name for field in fields(maps[0])]
    assert len(maps[0]) > 500
    assert all(getattr(maps[0], name).tobytes() == getattr(maps[1], name).tobytes() for name in columns)
