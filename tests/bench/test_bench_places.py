"""The bench of places counts right, wrong and refused frames."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from place_scenes import CAMERA, MapCamera, looking, room

from gausslite.cli.main import main
from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.render.map_viewer import view_map
from gausslite_bench.cli.places import PlaceScore, mirrored
from gausslite_bench.loop_trials import LoopTrials
from gausslite_places.prior_map import SavedMap

POSE = (0.5, 0.5, 30.0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    write_ply(tmp_path / "map.ply", room(3))
    write_keyframe_views(tmp_path, [KeyframeView(0, 0, CAMERA, looking(*POSE), 0)])
    return tmp_path


def test_right_wrong_and_refused_frames_are_counted(run: Path) -> None:
    saved, camera = SavedMap.read(run), MapCamera(room(3))
    places = saved.places(view_map(saved.gaussians, threads=1))
    frame = camera.frame(looking(0.55, 0.55, 30.0))
    score = PlaceScore.of(places, [frame, mirrored(frame)])
    assert (score.frames, score.right, score.wrong) == (2, 1, 0)
    assert score.error_m < 0.03
    assert score.line().startswith("2 frames: 1 right (")
    assert PlaceScore.of(places, [frame], elsewhere=True).wrong == 1


def test_another_place_is_refused(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="simulated homes come with the extra sim")
    source = "sim:home-4?frames=2&size=160x120"
    assert main(["bench", "places", str(run), source, "--elsewhere", "--threads", "1", "--json"]) == 0
    score = json.loads(capsys.readouterr().out)
    assert (score["frames"], score["right"], score["wrong"]) == (2, 0, 0)


def test_a_loop_counts_in_its_place_and_not_in_a_look_alike(run: Path) -> None:
    for package in ("gtsam", "kiss_matcher"):
        pytest.importorskip(package, reason="loops come with the extra slam")
    camera = MapCamera(room(3))
    trials = LoopTrials(SavedMap.read(run), [camera.frame(looking(*POSE))], threads=1)
    frame = camera.frame(looking(0.55, 0.55, 30.0))
    there = trials.score([frame], elsewhere=False)
    assert (there.frames, there.near, there.right, there.wrong) == (1, 1, 1, 0)
    elsewhere = trials.score([frame, mirrored(frame)], elsewhere=True)
    assert (elsewhere.frames, elsewhere.right, elsewhere.wrong) == (2, 0, 0), "also not for the same view 8 m away"
