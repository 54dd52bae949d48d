"""A small demo: four processes, two missions, one fused map, and no process left running."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gausslite.codec.ply import read_ply
from gausslite.datasets.open import open_source
from gausslite.domain.camera import back_project
from gausslite.domain.pose import transform_points
from gausslite.domain.recording import DepthRegistration

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

pytestmark = pytest.mark.slow

SMALL = ("--size", "128x96", "--max-gaussians", "5000", "--iterations", "3", "--set", "refine-iterations=20")


def _children_named(marker: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if marker in command and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def _write_recording(folder: Path) -> None:
    """Write a sequence of the simulated home in 7-Scenes layout, with the voxels of its table."""
    home = open_source("sim:home?seed=0&trajectory=0&frames=16&size=128x96")
    table = home.regions()["table"]
    folder.mkdir()
    k = home.camera
    np.savetxt(folder / "camera-intrinsics.txt", [[k.fx_px, 0, k.cx_px - 0.5], [0, k.fy_px, k.cy_px - 0.5], [0, 0, 1]])
    points = []
    for i in range(len(home)):
        frame = home.frame(i)
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), frame.rgb[..., ::-1])
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), (frame.depth_m * 1000).astype(np.uint16))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", frame.T_world_camera)
        points.append(transform_points(frame.T_world_camera, back_project(frame.depth_m, k)[table.mask(frame)]))
    voxels = np.unique(np.floor(np.concatenate(points) / 0.02).astype(np.int64), axis=0)
    np.savez(folder / "roi_voxels.npz", table_1=voxels, voxel_size_m=0.02)


def test_the_demo_maps_fuses_scores_and_ends_its_processes_on_a_recording_with_a_calibration(tmp_path: Path) -> None:
    folder, out = tmp_path / "recording", tmp_path / "demo"
    _write_recording(folder)
    camera = ",".join(np.loadtxt(folder / "camera-intrinsics.txt")[[0, 1, 0, 1], [0, 1, 2, 2]].astype(str))
    calibration = ("--set", f"register-depth={camera}", "--set", "pose-prior=0.01,0.5,0.1,0.03")
    tasks = ("--source", folder, "--task-a", "Find the table", "--task-b", "Find the table")
    command = [sys.executable, "-m", "gausslite", "demo", *SMALL, *map(str, tasks), *calibration, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    assert not _children_named(str(out))
    report = json.loads((out / "report.json").read_text())
    assert set(report["agents"]) == {"agent-a", "agent-b"}
    for agent in report["agents"].values():
        assert agent["frames"] == 7
        assert agent["hz"] > 0
        assert 0 < agent["roi_share"] < 1
        assert agent["bytes_sent"] > 0
        assert 0 < agent["map_shared_percent"] < 100
    assert set(report["maps"]) == {"agent-a", "agent-b", "concatenation", "vote", "refine"}
    for scores in report["maps"].values():
        assert scores["roi_psnr"] > 5
        assert scores["full_psnr"] > 5
        assert {task: of_task["roi_psnr"] for task, of_task in scores["tasks"].items()} == dict.fromkeys(
            ("agent-a", "agent-b"), scores["roi_psnr"]
        )
    assert "One map for all tasks: the voted map has" in done.stdout
    sizes = {name: len(read_ply(out / f"{name}.ply")) for name in ("concatenation", "vote")}
    both = sum(len(read_ply(out / agent / "map.ply")) for agent in report["agents"])
    # a handover leaves out distant guesses
    assert sizes["vote"] < sizes["concatenation"]
    assert 0.95 * both < sizes["concatenation"] <= both
    assert list((out / "pictures").glob("*.png"))
    assert f"{out / 'report.html'} shows them" in done.stdout
    page = (out / "report.html").read_text(encoding="utf-8")
    assert all(f"<th>{name}</th>" in page for name in report["maps"])
    assert "max-gaussians = 5000\n" in (out / "agent-a" / "config.toml").read_text()
    # the agents register depth and refine keyframes as the demo sets it
    assert "pose and exposure of each held-out view were fitted" in done.stdout
    assert DepthRegistration.parse(report["colour_camera"]) == DepthRegistration.parse(camera)
    assert report["view_error"] == "0.01,0.5,0.1,0.03"
    assert report["scored"] == {"objects": ["table_1"], "views": 2, "fitted": True, "frames_corrupt": 0}


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc to see processes")
def test_an_ended_session_ends_every_process_of_the_demo(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    frames = ("--set", "frames=0:10")
    command = [sys.executable, "-m", "gausslite", "demo", *SMALL, *frames, "--out", str(out)]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 120
        while len(_children_named(str(out / "agent-"))) < 2:
            assert demo.poll() is None, demo.stderr.read() if demo.stderr else ""
            assert time.monotonic() < deadline
            time.sleep(0.05)
        demo.send_signal(signal.SIGHUP)
        _, errors = demo.communicate(timeout=60)
    finally:
        demo.kill()
    assert demo.returncode == 130
    assert b"Traceback" not in errors
    assert not _children_named(str(out))
