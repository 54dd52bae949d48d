"""A robot that is lifted, covered or restarted is noticed and found again; one that drives on stays tracked."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from place_scenes import MapCamera, looking, room

from gausslite.datasets.open import open_source
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, translation_m
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.settings import MapperSettings, OptimizationSettings
from gausslite.mission.localisation_monitor import UNPLACED, LocalisationState
from gausslite.mission.runner import MissionTotals
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.cpu import CpuRasterizer
from gausslite_calibration.consistency import match_pair
from gausslite_calibration.live_check import FrameWindow, compared
from gausslite_relocalisation.monitor import FrameMonitor
from gausslite_relocalisation.motion import OdometrySteps
from gausslite_view.timeline import Timeline, read_timeline

TRACKED, DOUBTFUL, LOST = LocalisationState
STEP_NS = 200_000_000
HERE = [looking(0.8 + 0.04 * step, 0.8, 30.0 + 2.0 * step) for step in range(8)]
"""A tour along one side of the room."""
UNSEEN = [looking(3.2 - 0.03 * step, 2.2, 200.0 + 2.0 * step) for step in range(5)]
"""It looks at the wall that the tour has at its back."""
T_OTHER = transform_of(np.array([5.0, -2.0, 0.3, 0.0, 0.0, 2.0]))
SETTINGS = MapperSettings(max_gaussians=20_000, optimization=OptimizationSettings(1, 2))


@pytest.fixture(scope="module")
def camera() -> MapCamera:
    return MapCamera(room(3))


def _frames(camera: MapCamera, poses: Sequence[np.ndarray], first: int = 0, late_ns: int = 0) -> list[Frame]:
    return [
        replace(camera.frame(T, first + i), capture_time_ns=(first + i) * STEP_NS + late_ns)
        for i, T in enumerate(poses)
    ]


def _moved(frames: Sequence[Frame], T: np.ndarray) -> list[Frame]:
    return [replace(frame, T_world_camera=T @ frame.T_world_camera) for frame in frames]


def _mission(is_watched: bool = True) -> TaskMapper:
    mapper = GaussianMapper(SETTINGS, CpuRasterizer(threads=1))
    return TaskMapper(NoTaskEstimator(), mapper, monitor=FrameMonitor() if is_watched else None)


def _process(mission: TaskMapper, frames: Sequence[Frame]) -> list[FrameOutcome]:
    return [mission.process(frame) for frame in frames]


def _states(mission: TaskMapper, frames: Sequence[Frame]) -> list[LocalisationState]:
    return [mission.process(frame).localisation for frame in frames]


def _stands_still(again: list[Frame]) -> list[Frame]:
    return _moved(again, HERE[-1] @ inverse(again[0].T_world_camera))


Event = Callable[[list[Frame]], list[Frame]]
SHOWN: dict[str, Event] = {
    "the odometry begins again": lambda again: _moved(again, inverse(again[0].T_world_camera)),
    "the odometry begins far away": lambda again: _moved(again, T_OTHER),
}
"""The images show the motion that the odometry does not."""
UNSHOWN: dict[str, Event] = {
    "carried while the odometry stands still": _stands_still,
    "covered for ten seconds and carried": lambda again: _stands_still(
        [replace(frame, capture_time_ns=frame.capture_time_ns + 10_000_000_000) for frame in again]
    ),
    "the clock goes back and the odometry begins again": lambda again: [
        replace(frame, capture_time_ns=i * STEP_NS) for i, frame in enumerate(_moved(again, T_OTHER))
    ],
}


def _require_found(mission: TaskMapper, odometry: Frame) -> None:
    correction = mission.poses.latest()
    assert correction is not None
    error = inverse(HERE[6]) @ correction.T_map_odometry @ odometry.T_world_camera
    assert translation_m(error, np.eye(4)) < 0.05
    assert rotation_angle_deg(error, np.eye(4)) < 1.5
    assert mission.notes == ("doubts about the robot's place: 1; places found in the map: 1",)


def test_a_jump_too_far_for_a_robot_is_noticed_also_where_few_matches_show_another_motion(camera: MapCamera) -> None:
    frames = [*_frames(camera, HERE), *_moved(_frames(camera, HERE[6:7], first=len(HERE)), T_OTHER)]
    # depth in the left quarter of the image
    few = [replace(frame, depth_m=np.where(np.arange(240) < 70, frame.depth_m, np.float32(0.0))) for frame in frames]
    last, jumped = map(compared, few[-2:])
    pair = match_pair(FrameWindow((last, jumped)), 0, 1)
    assert pair is not None
    assert not pair.contradicts(inverse(jumped.T_world_camera) @ last.T_world_camera)
    steps = OdometrySteps()
    assert [steps.add(frame) is not None for frame in few] == [False] * len(HERE) + [True]
    assert steps.T_before_now is None


@pytest.mark.parametrize("event", SHOWN.values(), ids=SHOWN)
def test_a_jump_of_the_odometry_that_the_images_measure_costs_no_frame(camera: MapCamera, event: Event) -> None:
    mission = _mission()
    _process(mission, _frames(camera, HERE))
    again = event(_frames(camera, HERE[1:7], first=len(HERE)))
    assert {outcome.skipped for outcome in _process(mission, again)} == {None}
    _require_found(mission, again[-1])


@pytest.mark.parametrize("event", UNSHOWN.values(), ids=UNSHOWN)
def test_a_robot_that_lost_its_odometry_is_noticed_at_once_and_found_where_it_is(
    camera: MapCamera, event: Event
) -> None:
    mission = _mission()
    assert {outcome.skipped for outcome in _process(mission, _frames(camera, HERE))} == {None}
    before = mission.gaussians()
    again = event(_frames(camera, HERE[1:7], first=len(HERE)))
    outcomes = _process(mission, again)
    found = next(i for i, outcome in enumerate(outcomes) if outcome.skipped is None)
    assert [outcome.localisation for outcome in outcomes[:found]] == [DOUBTFUL, DOUBTFUL]
    assert {(outcome.skipped, outcome.gaussians) for outcome in outcomes[:found]} <= {(UNPLACED, len(before))}
    assert [outcome.index for outcome in outcomes[found].mapped] == [frame.index for frame in again[: found + 1]]
    assert all(outcome.localisation is TRACKED for outcome in outcomes[found:])
    _require_found(mission, again[-1])


def test_a_place_that_was_never_seen_changes_no_bit_of_the_map_and_the_mission_says_so(
    camera: MapCamera, tmp_path: Path
) -> None:
    mission = _mission()
    totals, timeline = MissionTotals(), Timeline()
    frames = _frames(camera, HERE)
    lost = _moved(_frames(camera, UNSEEN * 5, first=len(HERE)), HERE[-1] @ inverse(UNSEEN[0]))
    for outcome in _process(mission, frames):
        totals.add(outcome)
        timeline.add(outcome, PoseTable(), mission.parts)
    before = mission.gaussians()
    for outcome in _process(mission, lost):
        totals.add(outcome)
        timeline.add(outcome, PoseTable(), mission.parts)
    assert np.array_equal(mission.gaussians().means_m, before.means_m)
    assert mission.localisation is LOST
    assert mission.notes == (
        "the robot's place is lost since frame 8: its images contradict the map; its frames are not mapped",
    )
    assert (totals.frames, totals.reasons[UNPLACED]) == (len(frames), len(lost))
    timeline.write(tmp_path, ())
    assert read_timeline(tmp_path)["localisation"].tolist() == [0] * len(frames) + [1, 1] + [2] * (len(lost) - 2)
    # carried back: the frames of the way wait no longer than the limit, and those that contradict are not mapped
    back = _moved(_frames(camera, HERE[:6], first=60), T_OTHER)
    for outcome in _process(mission, back):
        totals.add(outcome)
    assert mission.localisation is TRACKED
    assert (totals.frames, totals.reasons[UNPLACED]) == (len(frames) + len(back), len(lost))


def test_a_robot_that_is_lifted_and_set_back_is_mapped_without_the_frames_from_the_air(camera: MapCamera) -> None:
    frames = _frames(camera, HERE)
    air = [replace(frame, T_world_camera=HERE[4]) for frame in _frames(camera, UNSEEN[:2], first=5)]
    after = _frames(camera, HERE[5:], first=7)
    watched, unwatched = _mission(), _mission(False)
    skipped = [outcome.skipped for outcome in _process(watched, [*frames[:5], *air, *after])]
    assert skipped == [None] * 5 + [UNPLACED] * 2 + [None] * 3
    _process(unwatched, [*frames[:5], *after])
    assert np.array_equal(watched.gaussians().means_m, unwatched.gaussians().means_m)


@pytest.mark.parametrize("gap_s", [0.0, 8.0], ids=["drives on", "camera without images for a while"])
def test_a_new_place_is_no_error(camera: MapCamera, gap_s: float) -> None:
    turn = [looking(0.9, 0.9, 44.0 + 26.0 * step) for step in range(1, 7)]
    frames = [
        *_frames(camera, HERE),
        *_frames(camera, turn, first=len(HERE), late_ns=round(1e9 * gap_s)),
    ]
    watched, unwatched = _mission(), _mission(False)
    outcomes = _process(watched, frames)
    _process(unwatched, frames)
    assert np.array_equal(watched.gaussians().means_m, unwatched.gaussians().means_m)
    assert outcomes[-1].skipped is None
    assert watched.localisation is TRACKED


HOMES = {
    "at its own poses": "sim:home?size=160x120",
    "noisy and blurred": "sim:home-1?size=160x120&noise=2&speed=60&blur=10ms",
}


@pytest.mark.parametrize(
    "address",
    [pytest.param(address, id=name, marks=[pytest.mark.slow] * ("blur" in address)) for name, address in HOMES.items()],
)
def test_a_mission_without_an_event_is_mapped_as_if_nobody_watched(address: str) -> None:
    home = open_source(address)
    frames = [home.frame(position, (160, 120)) for position in range(0, 40 if "blur" in address else 20, 2)]
    watched, unwatched = _mission(), _mission(False)
    assert {(outcome.skipped, outcome.localisation) for outcome in _process(watched, frames)} == {(None, TRACKED)}
    _process(unwatched, frames)
    maps = watched.gaussians(), unwatched.gaussians()
    for array in fields(maps[0]):
        assert np.array_equal(*(getattr(gaussians, array.name) for gaussians in maps)), array.name
    assert watched.notes == unwatched.notes


def test_a_restarted_mission_knows_that_it_was_lost_and_is_found(camera: MapCamera) -> None:
    first, second = _mission(), _mission()
    _process(first, _frames(camera, HERE))
    begins_again = UNSHOWN["the clock goes back and the odometry begins again"]
    again = begins_again(_frames(camera, [*UNSEEN[:3], *HERE[1:7]], first=len(HERE)))
    assert _process(first, again[:3])[-1].localisation is LOST
    second.restore(first.state())
    assert second.localisation is LOST
    outcomes = _process(second, again[3:])
    assert outcomes[-1].skipped is None
    assert second.localisation is TRACKED
    # another start is the same case: the state is that of another place
    third = _mission()
    third.restore(second.state())
    assert third.process(_frames(camera, HERE[2:3], first=30)[0]).localisation is DOUBTFUL
