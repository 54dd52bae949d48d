"""`gausslite eval` uses the settings in the report next to the map, unless options override them."""

import json
from pathlib import Path

import cv2
import pytest
from tiny_sequences import HEIGHT, write_seven_scenes

from gausslite.cli.main import main
from gausslite.mission.results import MAP_TO_ODOM, read_report

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
TRAINED = "map.ply was trained on these views; to score views that it has not seen, map and score with --test-every 8"
CAMERA, POSE_PRIOR = "20,20,7.5,5.5,-0.01,0,0,0,0,0", "0.01,0.5,0.1,0.03"


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    return write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 40, 4)))


def mapped(kitchen: Path, out: Path, *more: str) -> Path:
    common = ["--set", "target-at=0,0,2,0.4", "--set", "threads=1", "--max-gaussians", "150", "--out", str(out)]
    assert main(["map", str(kitchen), *common, *more]) == 0
    return out / "map.ply"


def test_the_report_next_to_a_map_sets_the_registration_and_fitting(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map_path = mapped(
        kitchen, tmp_path / "out", "--set", f"register-depth={CAMERA}", "--set", f"pose-prior={POSE_PRIOR}"
    )

    def score(*more: str) -> tuple[dict[str, float], str]:
        capsys.readouterr()
        assert main(["eval", str(map_path), str(kitchen), "--set", "threads=1", "--json", *more]) == 0
        captured = capsys.readouterr()
        return json.loads(captured.out), captured.err

    scores, message = score()
    assert message == f"from the report next to map.ply: register-depth {CAMERA} --poses refine\n{TRAINED}\n"
    assert scores == score("--set", f"register-depth={CAMERA}", "--poses", "refine")[0]
    raw, message = score("--set", f"register-depth={CAMERA}", "--poses", "given")
    assert (scores["fitted"], raw["fitted"], message) == (True, False, f"{TRAINED}\n")
    (map_path.parent / "report.json").write_text("[]")
    assert read_report(map_path.parent) == {}
    assert "the registration is estimated now" in score()[1]


def test_eval_scores_the_frames_that_were_held_out(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--set", "register-depth=none", "--set", "pose-prior=none", "--test-every", "5")
    map_path = mapped(kitchen, tmp_path / "out", *options)
    report = json.loads((map_path.parent / "report.json").read_text())
    assert (report["frames"], report["hold_out"], report["view_error"]) == (8, 5, None)
    capsys.readouterr()
    assert main(["eval", str(map_path), str(kitchen), "--set", "threads=1", "--json", "--test-every", "5"]) == 0
    assert json.loads(capsys.readouterr().out)["n_views"] == 2
    # without the option the report next to the map decides; 1 asks for all. A results folder stands for its map
    assert main(["eval", str(map_path.parent), str(kitchen), "--set", "threads=1", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["n_views"] == 2
    other_spelling = str(tmp_path / "out" / ".." / kitchen.name)
    assert main(["eval", str(map_path), other_spelling, "--set", "threads=1", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["n_views"] == 2
    assert "from the report next to map.ply: --test-every 5\n" in captured.err
    assert main(["eval", str(map_path), str(kitchen), "--set", "threads=1", "--json", "--test-every", "1"]) == 0
    assert json.loads(capsys.readouterr().out)["n_views"] == 10


def test_corrections_hold_for_the_mapped_source_alone(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map_path = mapped(kitchen, tmp_path / "out", "--set", "register-depth=none", "--set", f"pose-prior={POSE_PRIOR}")
    corrections = map_path.with_name(MAP_TO_ODOM)
    corrections.write_text("0 0.01 0 0 0 0 0 1\n")
    other = write_seven_scenes(tmp_path / "other", tuple(range(0, 40, 4)))
    other_spelling = Path(f"{tmp_path}/out/../{kitchen.name}")
    for source, is_used in ((kitchen, True), (other_spelling, True), (other, False)):
        capsys.readouterr()
        assert main(["eval", str(map_path), str(source), "--set", "threads=1", "--json", "--test-every", "5"]) == 0
        captured = capsys.readouterr()
        assert ("map_to_odom" in json.loads(captured.out)) == is_used
        assert ("corrects the poses of another source: not used" in captured.err) != is_used


def test_a_map_has_a_preview_next_to_recorded_images(kitchen: Path, tmp_path: Path) -> None:
    map_path = mapped(kitchen, tmp_path / "out", "--set", "register-depth=none", "--set", "pose-prior=none")
    preview = cv2.imread(str(map_path.parent / "preview.png"))
    # two keyframes in ten frames: one row each of recorded image, map, and the region in both
    assert preview.shape[1] > 4 * 320
    assert preview.shape[0] > 2 * 320 * HEIGHT / 16


def test_views_of_another_world_are_scored_with_a_message(
    kitchen: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map_path = mapped(kitchen, tmp_path / "out", "--set", "register-depth=none", "--set", "pose-prior=none")
    other = write_seven_scenes(tmp_path / "office", (0, 4))
    for source, is_other in ((kitchen, False), (other, True)):
        capsys.readouterr()
        assert main(["eval", str(map_path), str(source), "--set", "threads=1"]) == 0
        expected = f"is in the world frame 'kitchen', the poses of {source} in 'office'; the scores hold only if"
        assert (expected in capsys.readouterr().err) is is_other
