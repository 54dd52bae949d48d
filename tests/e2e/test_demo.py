"""The demo, small: four real processes, two missions, one fused map, and nothing left running."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gausslite.codec.ply import read_ply

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

SMALL = ("--size", "128x96", "--max-gaussians", "5000", "--iterations", "3", "--refine-iterations", "20")


def _command(out: Path) -> list[str]:
    frames = ("--frames-a", "0:10", "--frames-b", "0:10")
    return [sys.executable, "-m", "gausslite", "demo", *SMALL, *frames, "--out", str(out)]


def _children_named(marker: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if marker in words and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def test_the_demo_maps_fuses_scores_and_ends_everything(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = subprocess.run(_command(out), capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert set(report["agents"]) == {"agent-a", "agent-b"}
    for agent in report["agents"].values():
        assert agent["frames"] == 10
        assert agent["hz"] > 0
        assert 0 < agent["roi_share"] < 1
        assert agent["bytes_sent"] > 0
        assert 0 < agent["map_shared_percent"] < 100
    assert set(report["maps"]) == {"agent-a", "agent-b", "concatenation", "vote", "refine"}
    for scores in report["maps"].values():
        assert scores["roi_psnr"] > 5
        assert scores["full_psnr"] > 5
    sizes = {name: len(read_ply(out / f"{name}.ply")) for name in ("concatenation", "vote")}
    both = sum(len(read_ply(out / agent / "map.ply")) for agent in report["agents"])
    assert sizes["vote"] < sizes["concatenation"] == both
    assert list((out / "pictures").glob("*.png"))
    assert not _children_named(str(out))


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc to see processes")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_interrupting_the_demo_ends_every_process(tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "demo"
    demo = subprocess.Popen(_command(out), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 120
        while len(_children_named(str(out / "agent-"))) < 2:
            assert demo.poll() is None, demo.stderr.read() if demo.stderr else ""
            assert time.monotonic() < deadline
            time.sleep(0.05)
        demo.send_signal(number)
        _, errors = demo.communicate(timeout=60)
    finally:
        demo.kill()
    assert demo.returncode == 130
    assert b"Traceback" not in errors
    assert not _children_named(str(out))
