"""`gausslite eval` scores a map with what it was made with, as the report beside it says, unless told otherwise."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
from tiny_sequences import HEIGHT, write_seven_scenes

from gausslite.cli.main import main
from gausslite.mission.results import read_report

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
CAMERA, VIEW_ERROR = "20,20,7.5,5.5,-0.01,0,0,0,0,0", "0.01,0.5,0.1,0.03"


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    return write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 40, 4)))


def mapped(kitchen: Path, out: Path, *more: str) -> Path:
    common = ["--roi-ball", "0,0,2,0.4", "--threads", "1", "--max-gaussians", "150", "--out", str(out)]
    assert main(["map", str(kitchen), *common, *more]) == 0
    return out / "map.ply"


def test_the_report_beside_a_map_says_how_it_is_scored(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = mapped(kitchen, tmp_path / "out", "--register-depth", CAMERA, "--pose-prior", VIEW_ERROR)

    def score(*more: str) -> tuple[dict[str, float], str]:
        capsys.readouterr()
        assert main(["eval", str(made), str(kitchen), "--threads", "1", "--json", *more]) == 0
        said = capsys.readouterr()
        return json.loads(said.out), said.err

    scores, told = score()
    assert told == f"from the report next to map.ply: --register-depth {CAMERA} --fit-views\n"
    assert scores == score("--register-depth", CAMERA, "--fit-views")[0]
    raw, told = score("--register-depth", CAMERA, "--no-fit-views")
    assert (scores["fitted"], raw["fitted"], told) == (True, False, "")
    (made.parent / "report.json").write_text("[]")
    assert read_report(made.parent) == {}
    assert "the registration is estimated now" in score()[1]


def test_frames_that_are_held_out_are_those_that_eval_scores(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--register-depth", "none", "--pose-prior", "none", "--test-every", "5")
    made = mapped(kitchen, tmp_path / "out", *asked)
    report = json.loads((made.parent / "report.json").read_text())
    assert (report["frames"], report["hold_out"], report["view_error"]) == (8, 5, None)
    capsys.readouterr()
    assert main(["eval", str(made), str(kitchen), "--threads", "1", "--json", "--test-every", "5"]) == 0
    assert json.loads(capsys.readouterr().out)["n_views"] == 2


def test_a_map_comes_with_a_picture_of_it_beside_photographs(kitchen: Path, tmp_path: Path) -> None:
    made = mapped(kitchen, tmp_path / "out", "--register-depth", "none", "--pose-prior", "none")
    preview = cv2.imread(str(made.parent / "preview.png"))
    # two keyframes in ten frames: a row each, of photograph, map, and the region in both
    assert preview.shape[1] > 4 * 320
    assert preview.shape[0] > 2 * 320 * HEIGHT / 16
