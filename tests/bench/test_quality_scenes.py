"""Scenes of trials: masks match their frames, trial keys depend on the sequence, invalid input is refused early."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame
from tiny_sequences import write_depth, write_seven_scenes

from gausslite.cli.main import main
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.relevance import RelevanceMap
from gausslite.mission.settings import SceneInfo
from gausslite_bench.quality.real_scenes import real_plans
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene


def write_regions(path: Path, *voxels: tuple[int, int, int], name: str = "mug_1") -> Path:
    arrays = {name: np.array(voxels, np.int32)}
    np.savez(path, voxel_size_m=0.1, **arrays)
    return path


def test_recorded_relevance_matches_frames_by_identity() -> None:
    frames = [wall_frame(0), wall_frame(1)]
    masks = [middle_relevance(frames[0]), RelevanceMap.empty(*frames[1].depth_m.shape)]
    estimator = RecordedRelevanceEstimator(Scene("Find it", frames, masks, [], SceneInfo()))
    assert [estimator.estimate(frame).relevance for frame in frames] == masks
    assert estimator.evaluate_past(frames[0]) is masks[0]
    with pytest.raises(InvalidInputError, match="different indices"):
        RecordedRelevanceEstimator(Scene("Find it", [frames[0], frames[0]], masks, [], SceneInfo()))


def test_changed_regions_change_the_settings_of_a_scene(tmp_path: Path) -> None:
    path = write_regions(tmp_path / "roi.npz", (0, 0, 20))
    [plan] = real_plans(tmp_path, path)
    before = plan.settings()
    assert plan.settings() == before
    write_regions(path, (0, 0, 20), (1, 0, 20))
    assert plan.settings() != before


def test_a_changed_camera_changes_the_settings_of_a_scene(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "kitchen")
    [plan] = real_plans(folder, write_regions(tmp_path / "roi.npz", (0, 0, 20)))
    before = plan.training_settings()
    (folder / "camera-intrinsics.txt").write_text("21 0 7.5\n0 21 5.5\n0 0 1\n")
    assert plan.training_settings() != before


@pytest.mark.parametrize("name", ["left/right_1", "_"])
def test_an_object_whose_name_cannot_name_a_file_is_refused_at_once(name: str, tmp_path: Path) -> None:
    path = write_regions(tmp_path / "roi.npz", (0, 0, 20), name=name)
    with pytest.raises(InvalidInputError, match=r"roi\.npz: expected objects that can name files, got"):
        real_plans(tmp_path, path)


def test_a_sequence_too_short_for_a_held_out_view_is_refused_with_its_counts(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "kitchen")
    [plan] = real_plans(folder, write_regions(tmp_path / "roi.npz", (0, 0, 20)))
    with pytest.raises(DatasetError, match="expected training frames and held-out views with depth, got 3 and 0"):
        plan.load((16, 16))


WALL = [(x, y, z) for x in range(-4, 4) for y in range(-4, 4) for z in (19, 20)]


def write_kitchen(folder: Path, **regions: list[tuple[int, int, int]]) -> tuple[Path, Path]:
    """Nine views of a wall two metres away, and a file of regions."""
    roi = folder / "roi.npz"
    np.savez(roi, voxel_size_m=0.1, **{name: np.array(voxels, np.int32) for name, voxels in regions.items()})
    return write_seven_scenes(folder / "kitchen", tuple(range(0, 36, 4))), roi


def bench_quality(kitchen: Path, roi: Path, out: Path) -> int:
    options = ["--real", str(kitchen), "--roi", str(roi), "--size", "24x18", "--policies", "task", "--iterations", "1"]
    return main(["bench", "quality", *options, "--max-gaussians", "150", "--threads", "1", "--out", str(out)])


def test_a_kind_that_no_held_out_view_shows_is_skipped_with_a_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    kitchen, roi = write_kitchen(tmp_path, mug_1=WALL, lamp_1=[(500, 500, 500)])
    assert bench_quality(kitchen, roi, tmp_path / "out") == 0
    output = capsys.readouterr()
    reason = "kitchen-lamp: expected held-out views that show at least 64 pixels of lamp_1 at 24x18, got none of 1"
    assert f"skipped: {reason}" in output.err
    assert re.search(r"\| kitchen-mug \| Find the mug \| [\d.]+% in 1 of 1 views \|", output.out)
    assert "kitchen-lamp" not in output.out


def test_a_sequence_without_depth_has_its_own_message(tmp_path: Path) -> None:
    kitchen, roi = write_kitchen(tmp_path, mug_1=WALL)
    for path in kitchen.glob("*.depth.png"):
        write_depth(path, value=0)
    [plan] = real_plans(kitchen, roi)
    with pytest.raises(DatasetError, match="expected training frames and held-out views with depth, got 0 and 0"):
        plan.load((16, 16))


def test_regions_of_another_sequence_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    kitchen, roi = write_kitchen(tmp_path, lamp_1=[(500, 500, 500)])
    assert bench_quality(kitchen, roi, tmp_path / "out") == 2
    assert "gausslite: kitchen-lamp: expected held-out views that show" in capsys.readouterr().err
    assert not (tmp_path / "out" / "quality.md").exists()


@pytest.mark.slow
def test_regions_that_no_frame_shows_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    kitchen, roi = write_kitchen(tmp_path, mug_1=WALL, lamp_1=[(500, 500, 500)])
    for name, reported in (("lamp_1", True), ("mug_1", False)):
        options = ["--roi", str(roi), "--objects", name, "--max-gaussians", "150", "--set", "threads=1"]
        assert main(["map", str(kitchen), *options, "--out", str(tmp_path / name)]) == 0
        assert ("none of these frames shows the selected region" in capsys.readouterr().out) is reported
    assert (
        main(["eval", str(tmp_path / "mug_1" / "map.ply"), str(kitchen), "--roi", str(roi), "--objects", "lamp_1"]) == 0
    )
    assert capsys.readouterr().out.startswith("no view shows 64 pixels of the region; full PSNR ")
    assert main(["eval", str(tmp_path / "mug_1" / "map.ply"), str(kitchen)]) == 0
    assert capsys.readouterr().out.startswith("no region selected; full PSNR ")


def test_the_regions_file_of_a_sequence_is_the_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    kitchen, roi = write_kitchen(tmp_path, mug_1=WALL)
    options = ["bench", "quality", "--real", str(kitchen), "--policies", "task", "--iterations", "1", "--threads", "1"]
    options += ["--max-gaussians", "150", "--out", str(tmp_path / "out")]
    assert main(options) == 2
    assert f"and no {kitchen / 'roi_voxels.npz'}" in capsys.readouterr().err
    roi.rename(kitchen / "roi_voxels.npz")
    assert main(options) == 0
    # the sequence keeps its own size of 16x12, because it has fewer pixels than 320x240
    [record] = (tmp_path / "out" / "trials").glob("kitchen-mug-task-*.json")
    assert "size=(16, 12)" in json.loads(record.read_text())["conditions"]


def test_invalid_kinds_are_refused_before_registration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kitchen, roi = write_kitchen(tmp_path, mug_1=WALL)
    options = ["--real", str(kitchen), "--roi", str(roi), "--kinds", "mugs", "--out", str(tmp_path / "out")]
    assert main(["bench", "quality", *options]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "kinds: expected names among mug, got mugs" in line
