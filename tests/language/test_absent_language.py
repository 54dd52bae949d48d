"""Without this package a region is mapped, services start, and one line names the package where a sentence comes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from gausslite.nouns import PlainNouns, meant_by, vocabulary
from gausslite_language import nouns

HIDING = Path(__file__).resolve().parents[1] / "support" / "without_extras"
MISSING = "needs the package gausslite_language, which is not installed"
FRAMES = ("sim:home", "--frames", "0:2", "--size", "160x120", "--out")


def run_without_language(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(filter(None, (str(HIDING), os.environ.get("PYTHONPATH"))))
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path, "HIDDEN_PACKAGES": "gausslite_language"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_regions_are_mapped(tmp_path: Path) -> None:
    regions, out = tmp_path / "regions.npz", tmp_path / "run"
    np.savez(regions, voxel_size_m=1.0, wall=np.argwhere(np.ones((6, 6, 3))))
    done = run_without_language("-m", "gausslite", "map", *FRAMES, out, "--roi", regions)
    assert done.returncode == 0, done.stderr
    assert (out / "map.ply").is_file()


@pytest.mark.parametrize(
    "arguments",
    [
        ("gausslite", "map", *FRAMES, "run", "--task", "Pick up the mug"),
        ("gausslite", "parse", "Pick up the mug"),
        ("gausslite", "objects", "run"),
        ("gausslite_agent", "--listen", "127.0.0.1:0", "--task", "Pick up the mug", "--source", "sim:home"),
        ("gausslite_parser", "--listen", "127.0.0.1:0"),
    ],
)
def test_one_line_names_the_package_where_it_is_needed(arguments: Sequence[str], tmp_path: Path) -> None:
    out = [str(tmp_path / text) if text == "run" else text for text in arguments]
    done = run_without_language("-m", *out)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].endswith(MISSING)
    assert "Traceback" not in done.stderr


def test_services_and_their_settings_are_imported() -> None:
    modules = "gausslite.api, gausslite_agent.program, gausslite_fusion_server.program, gausslite_parser.program"
    done = run_without_language("-c", f"import {modules}")
    assert done.returncode == 0, done.stderr


def test_the_core_uses_the_installed_vocabulary_and_heads_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    assert vocabulary() is nouns
    names = ("lawn chair", "mug", "tap", "wall")
    assert meant_by("faucet", names) == ("tap",)
    monkeypatch.setattr("gausslite.nouns.vocabulary", PlainNouns)
    assert [meant_by(noun, names) for noun in ("faucet", "chair", "cup")] == [(), ("lawn chair",), ("mug",)]
