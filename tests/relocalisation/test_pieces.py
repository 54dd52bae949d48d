"""What a lost robot sees of an unknown place is mapped apart, and joined when it drives to a place of its map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from place_scenes import MapCamera, looking, room

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, translation_m
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings, MapperSettings
from gausslite.mission.localisation_monitor import UNPLACED, LocalisationState
from gausslite.mission.runner import MissionTotals
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.cpu import CpuRasterizer
from gausslite_agent.state import FrameReport, Outcome, StatusHolder, WorkerStatus
from gausslite_relocalisation.monitor import FrameMonitor
from gausslite_relocalisation.piece import Piece

LOST, TRACKED = LocalisationState.LOST, LocalisationState.TRACKED
HERE = [looking(0.8 + 0.04 * step, 0.8, 30.0 + 2.0 * step) for step in range(8)]
"""A tour along one side of the room."""
AWAY = [looking(3.4 - 0.16 * step, 2.2, 190.0 + 5.0 * step) for step in range(15)]
"""A way along the other side, with new views at each step."""
BACK = [looking(1.16 - 0.02 * step, 2.1 - 0.08 * step, 263.0 + 8.0 * step) for step in range(17)]
"""From there to the start of the tour."""
STEP_NS = 200_000_000
SETTINGS = MapperSettings(max_gaussians=20_000, keyframes=KeyframeSettings(long_term_keyframes=0))
"""Few keyframes, in which a place is searched faster."""


@pytest.fixture(scope="module")
def camera() -> MapCamera:
    return MapCamera(room(3))


def _frames(camera: MapCamera, poses: Sequence[np.ndarray], first: int = 0) -> list[Frame]:
    return [replace(camera.frame(T, i), capture_time_ns=i * STEP_NS) for i, T in enumerate(poses, first)]


def _carried(camera: MapCamera, poses: Sequence[np.ndarray]) -> list[Frame]:
    """Return the frames after the tour, of an odometry that stood still while the robot was carried."""
    T_odometry_world = HERE[-1] @ inverse(poses[0])
    frames = _frames(camera, poses, len(HERE))
    return [replace(frame, T_world_camera=T_odometry_world @ frame.T_world_camera) for frame in frames]


def _mission() -> TaskMapper:
    mapper = GaussianMapper(SETTINGS, CpuRasterizer(threads=1))
    return TaskMapper(NoTaskEstimator(), mapper, monitor=FrameMonitor())


def _require_joined(mission: TaskMapper, true: Sequence[np.ndarray]) -> None:
    """Require the poses of all frames, and a map in the room."""
    poses = mission.poses.state()
    in_map = dict(zip(poses["frames"][:, 0].tolist(), poses["T_world_map"], strict=True))
    for index, T in enumerate([*HERE, *true]):
        if index in in_map:
            assert translation_m(in_map[index], T) < 0.08, index
            assert rotation_angle_deg(in_map[index], T) < 2.0, index
    assert len(in_map) > len(HERE) + len(AWAY)
    means_m = mission.gaussians().means_m
    outside = ((means_m < -0.3) | (means_m > (4.3, 3.3, 2.7))).any(axis=1)
    assert outside.sum() <= 2  # of 14 000; a piece that is joined elsewhere has thousands


def _squared_error(mission: TaskMapper, camera: MapCamera) -> float:
    """Return the mean squared error of the colours of three views of the tour, which a piece may cover."""
    views = _frames(camera, HERE[::3])
    errors = (mission.render(view.camera, view.T_world_camera).rgb - view.rgb / 255.0 for view in views)
    return float(np.mean([np.square(error) for error in errors]))


def test_a_piece_is_no_part_of_the_map_before_the_robot_is_found_and_is_joined_then(camera: MapCamera) -> None:
    mission, resumed = _mission(), _mission()
    totals, agent = MissionTotals(), StatusHolder(WorkerStatus())

    def count(outcome: FrameOutcome) -> FrameOutcome:
        totals.add(outcome)
        kind = Outcome.MAPPED if outcome.skipped is None else Outcome.SKIPPED
        agent.count(FrameReport(outcome.index, kind), 0, outcome if kind is Outcome.MAPPED else None)
        return outcome

    for frame in _frames(camera, HERE):
        count(mission.process(frame))
    before = mission.gaussians()
    frames = _carried(camera, [*AWAY, *BACK, *HERE])
    for frame in frames[: len(AWAY)]:
        outcome = count(mission.process(frame))
        assert (outcome.skipped, len(mission.gaussians())) == (UNPLACED, len(before))
    assert np.array_equal(mission.gaussians().means_m, before.means_m)
    assert mission.localisation is LOST
    [note] = mission.notes
    assert "frames are mapped apart, and left out of the map until its place is found" in note
    resumed.restore(mission.state())
    for frame in frames[len(AWAY) :]:
        if count(resumed.process(frame)).joined:
            assert _squared_error(resumed, camera) < 0.0018
    assert resumed.localisation is TRACKED
    assert resumed.notes[-1] == "pieces that were mapped apart: 1 joined to the map, 0 left out"
    _require_joined(resumed, [*AWAY, *BACK, *HERE])
    assert len(resumed.gaussians()) > 1.5 * len(before)
    mapped = len(resumed.poses)
    assert (totals.frames, agent.status.mapped) == (mapped, mapped)
    assert totals.skipped == agent.status.skipped == len(HERE) + len(frames) - mapped


@pytest.mark.slow
def test_a_piece_in_which_the_robot_is_lost_again_is_left_out(camera: MapCamera) -> None:
    mission = _mission()
    for frame in _frames(camera, HERE):
        mission.process(frame)
    before = mission.gaussians()
    for frame in _carried(camera, AWAY):
        mission.process(frame)
    first = len(HERE) + len(AWAY)
    T_stands_still = HERE[-1] @ inverse(AWAY[0]) @ AWAY[-1]
    elsewhere = [looking(1.2 + 0.03 * step, 2.4, 100.0 - 2.0 * step) for step in range(4)]
    for frame in _frames(camera, elsewhere, first):
        T = T_stands_still @ inverse(elsewhere[0]) @ frame.T_world_camera
        mission.process(replace(frame, T_world_camera=T))
    assert mission.localisation is LOST
    assert mission.notes[-1] == "pieces that were mapped apart: 0 joined to the map, 1 left out"
    assert np.array_equal(mission.gaussians().means_m, before.means_m)


def test_a_full_map_has_no_room_for_a_piece(camera: MapCamera) -> None:
    mapper = GaussianMapper(MapperSettings(max_gaussians=500), CpuRasterizer(threads=1))
    assert Piece.fits(mapper)
    for frame in _frames(camera, HERE[:2]):
        TaskMapper(NoTaskEstimator(), mapper).process(frame)
    assert not Piece.fits(mapper)


def test_a_run_that_was_saved_before_pieces_existed_is_resumed() -> None:
    saved = FrameMonitor().state()
    del saved["pieces"]
    monitor = FrameMonitor()
    monitor.restore(saved)
    assert monitor.state()["pieces"].tolist() == [0, 0]
