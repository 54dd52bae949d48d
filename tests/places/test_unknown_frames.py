"""Agents that do not know their frame: they stay apart until the server has found it, and it abstains when unsure."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from place_scenes import CAMERA, room

from gausslite.domain.camera import Camera
from gausslite.domain.errors import UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, transform_points
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, RoiSubset, VoxelGrid, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameFit, Misfit
from gausslite.fusion.keyframe_pool import AgentKeyframe, EncodedKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.frame_fit import Fit, SurfaceSamples, fit_frame
from gausslite_places.unknown_frames import Find, FrameSearch, find_frame, keyframe_samples

pytest.importorskip("kiss_matcher")

GRID = VoxelGrid(0.10)
ANYTHING = MissionConfig("", "", 0.10)
SETTINGS = FusionSettings(grid=GRID)
T_BEE_ROOM = transform_of(np.array([7.0, -5.0, 1.0, 0.0, 0.0, 2.6]))
"""Where the room is for the agent bee: 8.7 m and 149 degrees away."""
CENTRE_M = np.array([[2.0, 1.5, 1.2]])


def aligning(store: FusionStore | None = None, fit: Fit = fit_frame, find: Find = find_frame) -> FusionEngine:
    return FusionEngine(store or SqliteStore(), SETTINGS, aligner=MapAligner(GRID, fit, find))


@cache
def scan(seed: int, kappa: int = 5) -> Gaussians:
    """Two thirds of the room's Gaussians, with noise; each seed is another robot's map."""
    rng, whole = np.random.default_rng(seed), room(0)
    part = whole.take(np.sort(rng.permutation(len(whole))[: 2 * len(whole) // 3]))
    noise = rng.normal(0, 0.003, part.means_m.shape).astype(np.float32)
    rgb = np.clip(part.rgb + rng.normal(0, 0.03, part.rgb.shape), 0, 1).astype(np.float32)
    return replace(part, means_m=part.means_m + noise, rgb=rgb, kappa=np.full(len(part), kappa, np.uint32))


def samples(gaussians: Gaussians) -> SurfaceSamples:
    return SurfaceSamples.of(group_by_voxel(gaussians, GRID))


def send(engine: FusionEngine, agent_id: str, gaussians: Gaussians, seq: int = 1, unknown: bool = False) -> None:
    session = engine.join(agent_id, ANYTHING).session.session_id
    if unknown:
        engine.declare_frame(agent_id, None)
    engine.contribute(session, RoiSubset(agent_id, "", seq, seq, group_by_voxel(gaussians, GRID)), GRID)


def error_of(T_found: np.ndarray, T_agent_fused: np.ndarray) -> tuple[float, float]:
    """Return the error at the room's centre in metres, and in degrees."""
    error = T_found @ T_agent_fused
    away = transform_points(error, CENTRE_M) - CENTRE_M
    return float(np.linalg.norm(away)), rotation_angle_deg(error, np.eye(4))


def alignment_of(engine: FusionEngine, agent_id: str) -> FrameAlignment:
    return next(status.alignment for status in engine.status().agents if status.agent_id == agent_id)


def won(engine: FusionEngine, agent_id: str) -> int:
    return engine.maps.won_voxels(agent_id)


def report(x_m: float) -> ObjectReport:
    box = AxisAlignedBox((x_m - 0.1, 0.9, 0.4), (x_m + 0.1, 1.1, 0.6))
    mug = ObjectLandmark("mug-1", "mug", ObjectRole.TARGET, (x_m, 1.0, 0.5), box, 0.9, 1, 2)
    return ObjectReport(TaskGraph("", "Find the mug", ("mug",), (), ()), (mug,))


def test_an_agent_in_an_unknown_frame_stays_apart_until_the_server_has_found_it(tmp_path: Path) -> None:
    store: FusionStore = SqliteStore(tmp_path / "store.sqlite")
    engine = aligning(store)
    send(engine, "ant", scan(0))
    few = move_gaussians(scan(1, kappa=9), T_BEE_ROOM).take(np.arange(150))
    send(engine, "bee", few, unknown=True)
    engine.objects.report(engine.join("bee", ANYTHING).session, report(1.0))
    engine.align_due()
    apart = alignment_of(engine, "bee")
    assert apart.state is AlignmentState.UNLOCALISED
    assert "frame unknown: not in the team's map yet; too few surfaces" in apart.message
    assert (won(engine, "bee"), engine.query_objects()) == (0, ())
    shape = CAMERA.height_px, CAMERA.width_px
    seen = Frame(0, 0, np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), CAMERA, np.eye(4))
    assert engine.in_fused_frame([AgentKeyframe("bee", seen)]) == []

    send(engine, "bee", move_gaussians(scan(1, kappa=9), T_BEE_ROOM), seq=2)
    revision = engine.maps.revision()
    assert engine.align_due().is_changed
    found = alignment_of(engine, "bee")
    assert found.state is AlignmentState.CORRECTED
    assert "frame unknown: found by the server" in found.message
    error_m, error_deg = error_of(found.T_fused_agent, T_BEE_ROOM)
    assert (error_m < 0.03, error_deg < 0.5) == (True, True)
    assert won(engine, "bee") > 0
    assert len(engine.maps.changes(revision).won.batch) > 0
    [mug] = engine.query_objects()
    assert mug.landmark.centroid_m == pytest.approx(
        transform_points(found.T_fused_agent, np.array([[1.0, 1.0, 0.5]]))[0]
    )
    [moved] = engine.in_fused_frame([AgentKeyframe("bee", seen)])
    assert moved.frame.T_world_camera == pytest.approx(found.T_fused_agent)

    voxels = won(engine, "bee")
    store.close()
    store = SqliteStore(tmp_path / "store.sqlite")
    again = aligning(store)
    # it joins again without knowing its frame
    again.join("bee", ANYTHING)
    again.declare_frame("bee", None)
    assert np.array_equal(alignment_of(again, "bee").T_fused_agent, found.T_fused_agent)
    assert won(again, "bee") == voxels
    store.close()


def doubled(gaussians: Gaussians) -> Gaussians:
    """Two equal rooms beside each other."""
    return two_rooms(gaussians, gaussians, away_m=6.0)


def two_rooms(one: Gaussians, other: Gaussians, away_m: float = 12.0) -> Gaussians:
    """Return two rooms, the second one turned."""
    return Gaussians.concatenate([one, move_gaussians(other, transform_of(np.array([away_m, 0, 0, 0, 0, 0.5])))])


@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        (lambda: room(5), lambda: room(0), "overlap"),
        (lambda: room(0, mirrored=True), lambda: room(0), "overlap"),
        (lambda: room(0, texture_seed=3), lambda: room(0), "texture differs"),
        (lambda: scan(1), lambda: doubled(scan(0)), "overlap"),
        (lambda: doubled(scan(1)), lambda: scan(0), "fits in several places"),
        (lambda: scan(1), lambda: two_rooms(scan(0), scan(2)), "overlap"),
    ],
    ids=["another room", "a mirrored room", "other colours", "a repeated room", "one of two equal rooms", "two maps"],
)
def test_look_alike_rooms_are_not_aligned(source, target, reason: str) -> None:
    found = find_frame(samples(move_gaussians(source(), T_BEE_ROOM)), samples(target()))
    assert found.fit is None
    assert reason in found.reason


@pytest.mark.slow
def test_a_room_that_the_team_has_twice_is_found_with_the_rooms_beside_it() -> None:
    east, north = (transform_of(np.array([*shift_m, 0.0, 0.0, 0.0, 0.0])) for shift_m in ((4.0, 0.0), (0.0, 3.0)))
    beside = Gaussians.concatenate([move_gaussians(room(8), east), move_gaussians(room(5), north)])
    team = samples(two_rooms(Gaussians.concatenate([scan(0), beside]), scan(2)))
    walked_on = move_gaussians(Gaussians.concatenate([scan(1), beside]), T_BEE_ROOM)
    found = find_frame(samples(walked_on), team)
    assert found.fit is not None
    error_m, error_deg = error_of(found.fit.motion, T_BEE_ROOM)
    assert (error_m < 0.03, error_deg < 0.5) == (True, True)


@pytest.mark.slow
def test_without_a_known_frame_the_first_agent_defines_it_until_one_that_knows_its_own_joins() -> None:
    engine = aligning()
    T_ant_room = transform_of(np.array([1.0, 2.0, 0.0, 0.0, 0.0, -1.0]))
    send(engine, "ant", move_gaussians(scan(0), T_ant_room), unknown=True)
    send(engine, "bee", move_gaussians(scan(1, kappa=9), T_BEE_ROOM), unknown=True)
    engine.align_due()
    ant = alignment_of(engine, "ant")
    assert ant.state is AlignmentState.REFERENCE
    assert "the first agent" in ant.message
    assert error_of(inverse(T_ant_room) @ alignment_of(engine, "bee").T_fused_agent, T_BEE_ROOM)[0] < 0.03
    send(engine, "cat", scan(2, kappa=7))
    assert not alignment_of(engine, "ant").is_used
    engine.align_due()
    assert alignment_of(engine, "cat").state is AlignmentState.REFERENCE
    for name, T_agent_room in (("ant", T_ant_room), ("bee", T_BEE_ROOM)):
        assert error_of(alignment_of(engine, name).T_fused_agent, T_agent_room)[0] < 0.03
        assert won(engine, name) > 0 or name == "ant"


@pytest.mark.slow
def test_a_found_frame_that_newer_data_contradict_is_taken_back() -> None:
    wrong = transform_of(np.array([0.6, 0.4, 0.0, 0.0, 0.0, 0.2])) @ inverse(T_BEE_ROOM)
    fit = FrameFit(wrong, Misfit(0.1, 0.25), Misfit(0.0, 0.0), 9.0, 149.0, 500, True, False)
    store = SqliteStore()
    engine = aligning(store, fit=lambda *_: None, find=lambda *_: FrameSearch(fit))
    send(engine, "ant", scan(0))
    bee = move_gaussians(scan(1, kappa=9), T_BEE_ROOM)
    halves = [bee.take(np.arange(start, len(bee), 2)) for start in (0, 1)]
    send(engine, "bee", halves[0], unknown=True)
    engine.align_due()
    assert np.array_equal(alignment_of(engine, "bee").T_fused_agent, wrong)
    engine = aligning(store)
    send(engine, "bee", halves[1], seq=2)
    assert won(engine, "bee") > 0
    engine.align_due()
    taken_back = alignment_of(engine, "bee")
    assert taken_back.state is AlignmentState.UNLOCALISED
    assert "its former place contradicts ant" in taken_back.message
    assert won(engine, "bee") == 0
    engine.align_due()
    assert error_of(alignment_of(engine, "bee").T_fused_agent, T_BEE_ROOM)[0] < 0.03


def test_an_agent_that_knows_its_frame_now_is_used_as_sent() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    send(engine, "ant", scan(0), unknown=True)
    engine.align_due()
    assert "frame-alignment = trust" in alignment_of(engine, "ant").message
    assert won(engine, "ant") == 0
    engine.declare_frame("ant", np.eye(4))
    while engine.has_background_work:
        engine.work_in_background()
    assert won(engine, "ant") == len(group_by_voxel(scan(0), GRID))


@pytest.mark.slow
def test_a_search_that_fails_is_made_twice_and_then_with_more_data_or_after_the_agent_has_left() -> None:
    sizes: list[int] = []

    def find(source: SurfaceSamples, target: SurfaceSamples) -> FrameSearch:
        sizes.append(len(source))
        raise UnavailableError("the process of the comparisons ended 2 times, with code -9")

    engine = aligning(find=find)
    send(engine, "ant", scan(0))
    send(engine, "bee", scan(1).take(np.arange(400)), unknown=True)
    for _ in range(5):
        engine.align_due()
    assert len(sizes) == 2
    assert "the search failed: the process" in alignment_of(engine, "bee").message
    send(engine, "bee", scan(1), seq=2)
    for _ in range(5):
        engine.align_due()
    assert len(sizes) == 3
    assert sizes[2] > sizes[1]
    engine.evict("bee", ban=False)
    engine.align_due()
    send(engine, "bee", scan(1).take(np.arange(400)), unknown=True)
    engine.align_due()
    assert sizes[3:] == sizes[:1]


def test_a_keyframe_that_no_decoder_reads_ends_no_comparison_of_others() -> None:
    engine = aligning()  # without a decoder
    send(engine, "ant", scan(0))
    send(engine, "bee", scan(1), unknown=True)
    engine.join("bee", MissionConfig("", "", SETTINGS.grid.size_m))
    engine.keyframes.add(EncodedKeyframe("bee", 0, 1, 1, b"of another version"))
    send(engine, "cat", scan(2))
    engine.align_due()
    assert alignment_of(engine, "cat").fit is not None
    assert "the search failed: stored keyframe" in alignment_of(engine, "bee").message


def test_an_image_that_no_room_gives_has_not_more_samples_than_a_view() -> None:
    camera = Camera.centred(900.0, 960, 720)
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
    depth_m = (2.7 + 2.2 * np.sin(rows / 60) * np.sin(columns / 60)).astype(np.float32)
    waves = Frame(0, 0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m, camera, np.eye(4))
    assert 10_000 <= len(keyframe_samples(waves)) <= 20_000


def test_a_slow_disk_delays_nobody_while_keyframes_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    store, begun, released = SqliteStore(), Event(), Event()
    engine = aligning(store, find=lambda *_: FrameSearch(None))
    send(engine, "ant", scan(0))
    send(engine, "bee", scan(1), unknown=True)
    engine.join("bee", ANYTHING)
    engine.keyframes.add(EncodedKeyframe("bee", 0, 1, 1, b"an image"))
    read = store.keyframe

    def read_slowly(*arguments: Any) -> bytes:
        begun.set()
        assert released.wait(60)
        return read(*arguments)

    monkeypatch.setattr(store, "keyframe", read_slowly)
    with ThreadPoolExecutor(2) as threads:
        run = threads.submit(engine.align_due)
        assert begun.wait(60)
        try:
            assert threads.submit(engine.frames.get, "ant").result(30).is_used
        finally:
            released.set()
        run.result(60)


def test_many_names_in_unknown_frames_are_searched_in_turns() -> None:
    searched: list[int] = []
    engine = aligning(find=lambda source, _: searched.append(len(source)) or FrameSearch(None, "no overlap found"))
    send(engine, "ant", scan(0))
    for number in range(1, 4):
        send(engine, f"lost-{number}", scan(number).take(np.arange(1000 * number)), unknown=True)
    runs = [engine.align_due(at_most=1) for _ in range(4)]
    assert [run.is_due for run in runs] == [True, True, False, False]
    assert sorted(searched) == searched
    assert len(searched) == 3
    # others were compared meanwhile, and the one whose search is the oldest comes first
    send(engine, "ant", scan(4), seq=2)
    for number in (2, 1):
        send(engine, f"lost-{number}", scan(number), seq=2)
        engine.align_due(at_most=1)
    assert len(searched) == 5
