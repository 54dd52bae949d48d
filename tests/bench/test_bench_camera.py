"""The camera study: a real camera's walk is scored with and without correction, on the views of an ideal camera."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.domain.camera import Lens
from gausslite.domain.recording import CameraCorrection
from gausslite_bench.camera_study import CameraCondition, CameraScore, camera_table, read_truth

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

SMALL = ["--size", "96x72", "--frames", "6", "--views", "3", "--iterations", "2", "--speeds", "60", "--threads", "1"]


def test_the_study_scores_all_handlings_and_writes_its_files(tmp_path: Path) -> None:
    assert main(["bench", "camera", "--out", str(tmp_path), *SMALL]) == 0
    stored = json.loads((tmp_path / "camera.json").read_text())["scores"]
    assert [score["condition"] for score in stored] == [str(each) for each in CameraCondition]
    assert all(score["full_psnr"] > 10 for score in stored)
    assert stored[2]["correction"] == "lens=radtan:-0.2,0.03,0,0;readout=0.03;exposure=0.01"
    assert "| 60 |" in (tmp_path / "camera.md").read_text()


def test_the_table_states_the_difference_to_the_ideal_camera() -> None:
    scores = [
        CameraScore(30, CameraCondition.IDEAL, 25.0, 20.0, ""),
        CameraScore(30, CameraCondition.UNCORRECTED, 23.5, 19.0, ""),
        CameraScore(30, CameraCondition.TRUTH, None, 19.5, "readout=0.03"),
    ]
    row = camera_table(scores).splitlines()[-1]
    assert row == "| 30 | 25.00 (20.00) | 23.50 (19.00) [-1.50] | no view (19.50) |  |  |"


def test_the_true_camera_is_that_of_the_options() -> None:
    lens = Lens.parse("radtan:-0.2,0,0,0")
    assert read_truth(30.0, 10.0, "radtan:-0.2,0,0,0") == CameraCorrection(lens, 0.03, exposure_s=0.01)
    assert read_truth(0.0, 0.0, "none").is_identity
