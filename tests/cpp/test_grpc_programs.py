"""The C++ programs against real services: a mission from a folder, and the fused map as the Python client gets it."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from agent_running import TASK, Agent
from fusion_running import CAMERA, GRID, RunningServer, frame, make_subset, request

from gausslite.codec.ply import read_ply
from gausslite.domain.voxels import group_by_voxel
from gausslite.wire.convert import encode_colour, encode_depth

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    os.environ.get("GAUSSLITE_CPP_CLIENT") != "1", reason="the build takes a minute: set GAUSSLITE_CPP_CLIENT=1"
)


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    if any(shutil.which(name) is None for name in ("cmake", "g++", "protoc", "grpc_cpp_plugin")):
        pytest.skip("no C++ build tools: see docs/reference/wire.md")
    folder = Path(os.environ.get("GAUSSLITE_CPP_BUILD", tmp_path_factory.mktemp("cpp")))
    subprocess.run(["cmake", "-S", str(ROOT / "cpp"), "-B", str(folder)], check=True)
    subprocess.run(["cmake", "--build", str(folder), "--parallel", "2"], check=True)
    return folder


def run(*command):
    return subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=120)


@pytest.mark.timeout(1200)
def test_the_fetched_map_is_that_of_the_python_client(fusion: RunningServer, programs, tmp_path):
    session = fusion.client.join("ant", GRID).session_id
    subset = make_subset("ant", 1, {0: [4], 1: [2, 2], 5: [9] * 30})
    list(fusion.client.contribute([request(session, subset)], 20.0))
    done = run(programs / "gausslite_fetch_map", fusion.client.address, tmp_path / "map.ply")
    assert done.returncode == 0, done.stderr
    update = next(fusion.client.watch())
    expected = update.batch.gaussians
    got = group_by_voxel(read_ply(tmp_path / "map.ply"), GRID).gaussians
    assert len(got) == len(expected) == 33
    for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb"):
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), rtol=2e-5, atol=2e-6)


@pytest.mark.timeout(1200)
def test_a_folder_of_frames_is_mapped(robot: Agent, programs, tmp_path):
    (tmp_path / "camera.txt").write_text(
        f"{CAMERA.fx_px} {CAMERA.fy_px} {CAMERA.cx_px} {CAMERA.cy_px} {CAMERA.width_px} {CAMERA.height_px}\n"
    )
    for index in range(4):
        image = frame(index)
        (tmp_path / f"{index:04}.color.png").write_bytes(encode_colour(image.rgb, lossless=True))
        (tmp_path / f"{index:04}.depth.png").write_bytes(encode_depth(image.depth_m))
        np.savetxt(tmp_path / f"{index:04}.pose.txt", image.T_world_camera)
    done = run(programs / "gausslite_stream_frames", robot.client.address, tmp_path, TASK)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("4 frames mapped; mission ended: 4 frames")
    assert robot.client.status().gaussians > 0


@pytest.mark.timeout(1200)
def test_errors_are_one_line(robot: Agent, programs, tmp_path):
    nowhere = run(programs / "gausslite_fetch_map", "127.0.0.1:9", tmp_path / "map.ply")
    assert nowhere.returncode == 2
    assert len(nowhere.stderr.splitlines()) == 1
    empty = run(programs / "gausslite_stream_frames", robot.client.address, tmp_path, TASK)
    assert empty.returncode == 2
    assert "camera.txt: expected a readable file" in empty.stderr
