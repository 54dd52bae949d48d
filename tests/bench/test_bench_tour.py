"""`gausslite bench tour` goes there and back through homes and corridors, with parts of the map on disk."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")

from gausslite.cli.main import main
from gausslite.domain.camera import back_project, project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import inverse, transform_points, translation_m
from gausslite_bench.tour import TourSettings
from gausslite_bench.tour_building import CORRIDOR_FRAMES, Building, corridor_frames, planned_visits, record


def test_the_way_goes_there_and_back_and_a_carried_robot_misses_two_homes() -> None:
    assert [visit.home for visit in planned_visits(3, 2, ())] == [0, 1, 2, 1, 0, 1, 2, 1, 0]
    visits = planned_visits(4, 1, (2,))
    assert [(visit.number, visit.home) for visit in visits] == [(0, 0), (1, 1), (2, 2), (5, 1), (6, 0)]
    assert [visit.number for visit in visits if visit.is_carried] == [5]
    assert [visit.recordings for visit in visits[2:]] == [
        ("corridor-1", "home-2"),
        ("home-1",),
        ("corridor-0", "home-0"),
    ]


def test_a_corridor_shows_the_same_walls_from_each_place() -> None:
    frames = corridor_frames(1, 64)
    assert len(frames) == CORRIDOR_FRAMES
    for frame in frames:
        assert not frame.defect
        assert 0.5 < frame.depth_m.min() < frame.depth_m.max() < 8.0
    points_m = transform_points(frames[0].T_world_camera, back_project(frames[0].depth_m, frames[0].camera)).reshape(
        -1, 3
    )
    seen_m = transform_points(inverse(frames[1].T_world_camera), points_m.astype(np.float64))
    columns, rows = np.floor(project(seen_m.astype(np.float32), frames[1].camera)).astype(int).T
    inside = (columns >= 0) & (columns < 64) & (rows >= 0) & (rows < 48)
    same = (frames[1].rgb[rows[inside], columns[inside]] == frames[0].rgb.reshape(-1, 3)[inside]).all(axis=1)
    # pixels at the edges of tiles and far away differ
    assert same.mean() > 0.7


def test_the_odometry_stands_while_the_robot_is_carried_and_begins_again_when_it_restarts(tmp_path: Path) -> None:
    building = Building(tmp_path, planned_visits(4, 1, (2,)), restarts=(6,), drift=0.01)
    for home in range(3):
        for place in ("home", "corridor"):
            record(str(tmp_path / f"{place}-{home}.npz"), home, width=64, frames=0)
    odometry, true = building.odometry_poses, building.true_poses
    carried, restarted = 5 * CORRIDOR_FRAMES, 6 * CORRIDOR_FRAMES
    assert translation_m(true[carried - 1], true[carried]) > 3.0
    assert translation_m(odometry[carried - 1], odometry[carried]) == pytest.approx(0.0, abs=1e-9)
    assert odometry[restarted] == pytest.approx(np.eye(4))
    driven_m = [translation_m(poses[0], poses[12 * 5 - 1]) for poses in (true, odometry)]
    assert 0.0 < abs(driven_m[0] - driven_m[1]) < 2.0
    frames = [frame for visit in building.visits for _, frame in building.frames(visit)]
    assert [frame.index for frame in frames] == list(range(8 * CORRIDOR_FRAMES))
    steps_s = np.diff([frame.capture_time_ns for frame in frames]) / 1e9
    assert steps_s[restarted - 1] == 60.0
    assert np.median(steps_s) == 0.5


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ({"kidnaps": (4,)}, "kidnaps: expected visits from 1 to 3 that are made, got 4"),
        ({"restarts": (7,)}, "restarts: expected visits from 1 to 6 that are made, got 7"),
        ({"tasks": (0,)}, "tasks: expected visits from 1 to 6 that are made, got 0"),
    ],
)
def test_events_are_at_visits_of_the_tour(events: dict[str, tuple[int, ...]], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        TourSettings(homes=4, **events)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_tour_with_all_events_returns_to_a_home_that_was_on_disk(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (
        "--homes 3 --laps 2 --frames 40 --width 96 --iterations 2 --max-gaussians 8000 --disk-mb 50 --json "
        "--drift 0.1 --kidnaps 4 --restarts 3 --tasks 1,2"
    )
    assert main(["bench", "tour", *arguments.split()]) == 0
    report = json.loads(capsys.readouterr().out)
    visits = report["visits"]
    assert [row["home"] for row in visits] == [0, 1, 2, 1, 0, 1, 0]
    assert max(row["in_memory"] for row in visits) <= 8000
    assert visits[2]["gaussians"] > visits[2]["in_memory"]
    assert visits[0]["waited"] == 0
    assert report["poses"]["mapped"] > report["poses"]["frames"] / 2
