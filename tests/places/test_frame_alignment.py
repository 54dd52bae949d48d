"""Frames of a team: a misfit is measured and corrected, a gross one that others repeat is quarantined."""

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sample_gaussians import plain_gaussians
from sample_gaussians import textured_corner as corner

from gausslite.domain.camera import Camera
from gausslite.domain.errors import UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, transform_points
from gausslite.domain.voxels import (
    RoiSubset,
    VoxelBatch,
    VoxelGrid,
    group_by_voxel,
    merge_batches,
    select_voxels,
    tombstones,
)
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameFit
from gausslite.fusion.keyframe_pool import AgentKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.score_index import COMPARED_BYTES, COMPARED_VOXELS
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.frame_fit import Fit, SurfaceSamples, fit_frame

GRID = VoxelGrid(0.10)
ANYTHING = MissionConfig("", "", 0.10)
SETTINGS = FusionSettings(grid=GRID)


def aligning(store: FusionStore | None = None, fit: Fit = fit_frame) -> FusionEngine:
    return FusionEngine(store or SqliteStore(), SETTINGS, aligner=MapAligner(GRID, fit))


def wrong_frame(shift_m: tuple[float, float, float], angle_deg: float = 0.0) -> np.ndarray:
    axis = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    return transform_of(np.array([*shift_m, *(np.radians(angle_deg) * axis)]))


def send(engine: FusionEngine, agent_id: str, gaussians: Gaussians, seq: int = 1) -> None:
    session = engine.join(agent_id, ANYTHING).session.session_id
    engine.contribute(session, RoiSubset(agent_id, "", seq, seq, group_by_voxel(gaussians, GRID)), GRID)


def team(T_agent_fused: np.ndarray, store: FusionStore | None = None, fit: Fit = fit_frame) -> FusionEngine:
    """An engine with ant, in the fused frame, and bee, whose frame is wrong and whose kappa wins."""
    engine = aligning(store, fit)
    send(engine, "ant", corner(0))
    send(engine, "bee", move_gaussians(corner(1, kappa=9), T_agent_fused))
    return engine


def alignment_of(engine: FusionEngine, agent_id: str) -> FrameAlignment:
    return next(status.alignment for status in engine.status().agents if status.agent_id == agent_id)


def state_of(engine: FusionEngine, agent_id: str) -> AlignmentState:
    return alignment_of(engine, agent_id).state


def surface_error_m(points_m: np.ndarray) -> float:
    """Return the median distance of points to the corner's planes."""
    return float(np.median(np.abs(points_m).min(axis=1)))


def samples(gaussians: Gaussians) -> SurfaceSamples:
    return SurfaceSamples(gaussians.means_m.astype(np.float64), gaussians.rgb[:, 0].astype(np.float64))


@pytest.mark.parametrize(
    ("shift_m", "angle_deg"), [((0.03, -0.03, 0.025), 2.0), ((0.1, 0.0, 0.1), 3.0), ((0.3, 0.4, 0.2), 20.0)]
)
def test_the_fit_recovers_a_misfit(shift_m: tuple[float, float, float], angle_deg: float) -> None:
    T_agent_fused = wrong_frame(shift_m, angle_deg)
    fit = fit_frame(samples(move_gaussians(corner(1), T_agent_fused)), samples(corner(0)))
    assert fit is not None
    error = fit.motion @ T_agent_fused
    assert np.linalg.norm(transform_points(error, np.ones((1, 3))) - 1.0) < 0.01
    assert rotation_angle_deg(error, np.eye(4)) < 0.3
    assert fit.is_better
    assert fit.after.distance_m < 0.01 < fit.before.distance_m
    assert fit.after.colour < fit.before.colour


def test_the_same_frame_has_no_better_motion() -> None:
    fit = fit_frame(samples(corner(1)), samples(corner(0)))
    assert fit is not None
    assert not fit.is_better


def test_a_better_distance_with_a_worse_colour_is_no_better_fit() -> None:
    """A striped wall that slid by half a period: planes cannot show it, and a corner alone would."""
    first, second = samples(corner(0)), samples(move_gaussians(corner(1), wrong_frame((0.05, 0.05, 0.05))))
    grey = SurfaceSamples(second.points_m, np.random.default_rng(0).permutation(second.luminance))
    fit = fit_frame(grey, first)
    assert fit is not None
    assert fit.after.distance_m < fit.before.distance_m
    assert not fit.is_better


def test_too_little_shared_surface_gives_no_fit() -> None:
    assert fit_frame(samples(corner(1, count=30)), samples(corner(0))) is None
    far = move_gaussians(corner(1), wrong_frame((50.0, 0.0, 0.0)))
    assert fit_frame(samples(far), samples(corner(0))) is None


def test_a_frame_within_the_noise_changes_no_bit() -> None:
    engine = team(np.eye(4))
    before = engine.maps.voted_map()
    assert not engine.align_due().is_changed
    assert (state_of(engine, "ant"), state_of(engine, "bee")) == (AlignmentState.REFERENCE, AlignmentState.ALIGNED)
    assert engine.maps.voted_map().gaussians.means_m.tobytes() == before.gaussians.means_m.tobytes()


def test_five_centimetres_and_two_degrees_are_corrected_also_after_a_restart(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite")
    engine = team(wrong_frame((0.03, -0.03, 0.025), 2.0), store)
    wrong = surface_error_m(engine.maps.voted_map("bee").gaussians.means_m)
    revision = engine.maps.revision()
    assert engine.align_due().is_changed
    assert not engine.align_due().is_changed
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    corrected = surface_error_m(engine.maps.voted_map("bee").gaussians.means_m)
    assert wrong > 0.015
    assert corrected < 0.005
    assert engine.maps.revision() > revision
    # a watcher that follows the changes has the map of a new watcher
    assert len(engine.maps.changes(revision).won.batch) > 0
    store.close()
    store = SqliteStore(tmp_path / "store.sqlite")
    assert surface_error_m(aligning(store).maps.voted_map("bee").gaussians.means_m) == corrected
    store.close()


def table_part(seed: int, low_m: float, high_m: float) -> np.ndarray:
    """Points of a part of a table top at z = 0."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(low_m, high_m, 400), rng.uniform(0, 1, 400), rng.normal(0, 0.002, 400)])


def box_on_table(seed: int) -> np.ndarray:
    """Points of the sides and the top of a box of 10 cm on the table."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 0.1, (400, 3))
    face = rng.integers(0, 5, 400)
    points[np.arange(400), face // 2] = np.where(face == 4, 0.1, 0.1 * (face % 2))
    return points + np.array([0.4, 0.4, 0.0]) + rng.normal(0, 0.002, points.shape)


@pytest.mark.parametrize(
    "points",
    [box_on_table(1), table_part(1, 0.55, 1.0), np.vstack([box_on_table(1), table_part(1, 0.45, 0.8)])],
    ids=["a box on the table", "another part of the table", "box and another part"],
)
def test_correct_frames_of_regions_that_hardly_overlap_stay_as_they_are(points: np.ndarray) -> None:
    engine = aligning()
    send(engine, "ant", plain_gaussians(table_part(0, 0.0, 0.5), kappa=5))
    for seq in range(1, 5):
        send(engine, "bee", plain_gaussians(points[: seq * len(points) // 4], kappa=9), seq)
        engine.align_due()
        assert state_of(engine, "bee") in (AlignmentState.UNKNOWN, AlignmentState.ALIGNED)


WRONG = wrong_frame((0.25, 0.25, 0.2))


def halves(gaussians: Gaussians) -> list[Gaussians]:
    return [gaussians.take(np.arange(start, len(gaussians), 2)) for start in (0, 1)]


def send_twice(engine: FusionEngine, agent_id: str, gaussians: Gaussians) -> None:
    for seq, half in enumerate(halves(gaussians), start=1):
        send(engine, agent_id, half, seq)
        engine.align_due()


def test_a_gross_misfit_is_quarantined_if_newer_data_repeat_it_and_returns_when_it_is_mended() -> None:
    engine = aligning()
    send(engine, "ant", corner(0))
    first, second = halves(move_gaussians(corner(1, kappa=9), WRONG))
    send(engine, "bee", first)
    assert not engine.align_due().is_changed
    assert state_of(engine, "bee") is AlignmentState.UNKNOWN
    assert "contradicts ant" in alignment_of(engine, "bee").message
    send(engine, "bee", second, 2)
    assert engine.align_due().is_changed
    [bee] = [status for status in engine.status().agents if status.agent_id == "bee"]
    assert bee.alignment.state is AlignmentState.QUARANTINED
    assert "contradicts ant: 0." in bee.alignment.message
    assert "check the agent's localisation" in bee.alignment.message
    assert bee.gaussians > 0
    assert bee.won_voxels == 0
    assert {status.agent_id for status in engine.status().agents if status.won_voxels} == {"ant"}
    seen = Frame(0, 0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), Camera(8, 8, 4, 4, 8, 8), np.eye(4))
    kept = engine.in_fused_frame([AgentKeyframe("ant", seen), AgentKeyframe("bee", seen)])
    assert [keyframe.agent_id for keyframe in kept] == ["ant"]
    # the agent's localisation is mended, and it sends the same voxels again
    for seq, is_released in ((3, False), (4, True)):
        send(engine, "bee", corner(1, kappa=9), seq)
        engine.align_due()
        assert (state_of(engine, "bee") is not AlignmentState.QUARANTINED) == is_released
    assert len(engine.maps.voted_map("bee")) > 0


def test_a_lone_agent_that_two_others_contradict_is_quarantined_even_if_it_came_first() -> None:
    engine = aligning()
    send(engine, "ant", move_gaussians(corner(0, kappa=9), WRONG))
    for seed, name in enumerate(("bee", "cat"), start=1):
        send(engine, name, corner(seed))
        engine.align_due()
    states = {name: state_of(engine, name) for name in ("ant", "bee", "cat")}
    assert states["ant"] is AlignmentState.QUARANTINED
    assert states["bee"] is AlignmentState.REFERENCE
    assert states["cat"] is AlignmentState.ALIGNED
    assert {status.agent_id for status in engine.status().agents if status.won_voxels} == {"bee", "cat"}


def test_who_contradicts_an_evicted_agent_is_released_also_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    for restarts in (False, True):
        path.unlink(missing_ok=True)
        store = SqliteStore(path)
        engine = aligning(store)
        send(engine, "ant", move_gaussians(corner(0), WRONG))
        send_twice(engine, "bee", corner(1))
        assert state_of(engine, "bee") is AlignmentState.QUARANTINED
        if restarts:
            store.close()
            store = SqliteStore(path)
            engine = aligning(store)
            engine.align_due()
            assert state_of(engine, "bee") is AlignmentState.QUARANTINED
        engine.evict("ant", ban=True)
        assert engine.align_due().is_changed
        assert state_of(engine, "bee") is AlignmentState.REFERENCE
        won = {status.agent_id: status.won_voxels for status in engine.status().agents}
        assert won["bee"] > 0
        store.close()


def test_one_early_voxel_harms_nobody() -> None:
    engine = aligning()
    rng = np.random.default_rng(0)
    send(engine, "eve", plain_gaussians(rng.uniform(0.0, 0.1, (400, 3)), kappa=9))
    send_twice(engine, "ant", corner(0))
    send_twice(engine, "bee", corner(1))
    assert not engine.status().agents[0].alignment.message
    assert all(status.alignment.is_used for status in engine.status().agents)
    assert engine.maps.won_voxels("ant") + engine.maps.won_voxels("bee") > 100


class CountingStore(SqliteStore):
    """Records how many voxels each read asks for; -1 for all."""

    def __init__(self) -> None:
        super().__init__()
        self.reads: list[int] = []

    def batch(self, agent_id: str, keys: np.ndarray | None = None) -> VoxelBatch:
        self.reads.append(-1 if keys is None else len(keys))
        return super().batch(agent_id, keys)

    def batches(self, keys: np.ndarray | None = None) -> dict[str, VoxelBatch]:
        self.reads.append(-1 if keys is None else len(keys))
        return super().batches(keys)


def test_comparing_and_correcting_read_slices_and_never_a_whole_map() -> None:
    store = CountingStore()
    engine = team(wrong_frame((0.1, 0.0, 0.1), 3.0), store)
    store.reads.clear()
    assert engine.align_due().is_changed
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    assert len(store.reads) > 10
    assert 0 <= min(store.reads) <= max(store.reads) <= 128


def test_a_message_of_an_agent_in_another_frame_reads_its_own_voxels() -> None:
    for shift_m in ((5.0, 0.02, 0.0), (0.0, 0.0, 0.0)):
        store = CountingStore()
        engine = aligning(store)
        engine.join("bee", ANYTHING)
        engine.declare_frame("bee", wrong_frame(shift_m, 40.0))
        send(engine, "bee", corner(1))
        store.reads.clear()
        send(engine, "bee", plain_gaussians(np.full((1, 3), 0.05), kappa=99), 2)
        assert sum(store.reads) <= 1


@pytest.mark.parametrize("seed", range(5))
def test_moved_voxels_are_those_of_a_new_engine_whatever_the_order_of_messages(seed: int) -> None:
    rng, store = np.random.default_rng(seed), SqliteStore()
    engine = aligning(store)
    send(engine, "ant", corner(0))
    engine.join("bee", ANYTHING)
    for seq in range(1, 9):
        if rng.random() < 0.4:
            engine.declare_frame("bee", wrong_frame(tuple(rng.uniform(-0.5, 0.5, 3)), rng.uniform(0, 90)))
        for _ in range(int(rng.integers(0, 3))):
            engine.work_in_background()
        points = rng.uniform(0, rng.choice([0.3, 1.0]), (int(rng.integers(1, 80)), 3))
        batch = group_by_voxel(plain_gaussians(points, kappa=int(rng.integers(1, 12))), GRID)
        gone = tombstones(np.setdiff1d(store.batch("bee").keys, batch.keys)[: int(rng.integers(0, 4))])
        session = engine.join("bee", ANYTHING).session.session_id
        engine.contribute(session, RoiSubset("bee", "", seq, seq, merge_batches(batch, gone)), GRID)
    while engine.has_background_work:
        engine.work_in_background()
    again = aligning(store)
    for read in (lambda e: e.maps.voted_map(), lambda e: e.maps.union_map(), lambda e: e.maps.changes().won.batch):
        ours, theirs = read(engine), read(again)
        assert np.array_equal(ours.keys, theirs.keys)
        assert np.array_equal(ours.kappa_sums, theirs.kappa_sums)
        assert np.array_equal(np.sort(ours.gaussians.means_m, axis=0), np.sort(theirs.gaussians.means_m, axis=0))
    assert engine.maps.size() == again.maps.size()


def test_messages_are_stored_during_a_comparison_and_its_result_is_dropped_with_the_agents_data() -> None:
    def fit_while_others_work(source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
        with ThreadPoolExecutor(1) as executor:
            executor.submit(send, engine, "ant", corner(2), 2).result(timeout=60)
            if any(status.agent_id == "bee" for status in engine.status().agents):
                executor.submit(engine.evict, "bee").result(timeout=60)
        return fit_frame(source, target)

    engine = team(wrong_frame((0.1, 0.0, 0.1), 3.0), fit=fit_while_others_work)
    engine.align_due()
    assert [status.agent_id for status in engine.status().agents] == ["ant"]
    assert state_of(engine, "ant") is AlignmentState.REFERENCE


def test_an_agent_that_cannot_be_compared_stays_due_and_the_others_are_compared() -> None:
    calls = []

    def fail_once(source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
        calls.append(source)
        if len(calls) == 1:
            raise UnavailableError("killed")
        return fit_frame(source, target)

    engine = team(wrong_frame((0.1, 0.0, 0.1), 3.0), fit=fail_once)
    pytest.raises(UnavailableError, engine.align_due).match("agent 'ant': killed")
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    compared = len(calls)
    assert not engine.align_due().is_due
    assert len(calls) > compared


def test_agents_take_turns_and_a_single_earlier_agent_is_compared_once() -> None:
    pairs = []

    def count(source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
        pairs.append((len(source), len(target)))
        return fit_frame(source, target)

    engine = team(np.eye(4), fit=count)
    compared = []
    for seq in range(2, 6):
        engine.align_due(at_most=1)
        compared.append(pairs[-1][0])
        # both are due again
        send(engine, "ant", corner(0), seq)
        send(engine, "bee", corner(1, kappa=9), seq)
    ant, bee = compared[:2]
    assert ant != bee
    assert compared == [ant, bee, ant, bee]
    assert len(pairs) == len(compared)


def test_later_updates_of_a_drifting_agent_get_their_own_correction() -> None:
    engine = aligning()
    send(engine, "ant", corner(0))
    scene = corner(1, kappa=9)
    order = np.argsort(scene.means_m[:, 0], kind="stable")
    for seq, rows in enumerate(np.array_split(order, 4), start=1):
        drift = wrong_frame((0.0, 0.04 * seq, 0.04 * seq), 0.5 * seq)
        send(engine, "bee", move_gaussians(scene.take(rows), drift), seq)
        engine.align_due()
    [bee] = [status for status in engine.status().agents if status.agent_id == "bee"]
    assert bee.alignment.state is AlignmentState.CORRECTED
    assert len(bee.alignment.segments) > 1
    assert surface_error_m(engine.maps.voted_map("bee").gaussians.means_m) < 0.01


def test_a_declared_frame_is_used_and_can_be_refined() -> None:
    T_agent_fused = wrong_frame((5.0, 0.0, 0.0), 40.0)
    engine = aligning()
    send(engine, "ant", corner(0))
    engine.join("bee", ANYTHING)
    engine.declare_frame("bee", wrong_frame((0.05, 0.03, 0.0)) @ inverse(T_agent_fused))
    send(engine, "bee", move_gaussians(corner(1, kappa=9), T_agent_fused))
    engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    assert surface_error_m(engine.maps.voted_map("bee").gaussians.means_m) < 0.005


def test_a_keyframe_that_a_declared_frame_moves_out_of_range_is_left_out() -> None:
    engine = aligning()
    engine.join("bee", ANYTHING)
    engine.declare_frame("bee", wrong_frame((9000.0, 0.0, 0.0)))
    near, far = (
        Frame(0, 0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), Camera(8, 8, 4, 4, 8, 8), T)
        for T in (np.eye(4), wrong_frame((5000.0, 0.0, 0.0)))
    )
    [moved] = engine.in_fused_frame([AgentKeyframe("bee", near), AgentKeyframe("bee", far)])
    assert moved.frame.T_world_camera[0, 3] == 9000.0


def test_a_keyframe_of_a_pose_and_a_declared_frame_that_are_hardly_rigid_is_moved() -> None:
    engine = aligning()
    engine.join("bee", ANYTHING)
    T = np.diag([1.0047, 1.0, 1.0, 1.0])
    T[0, 3], T[3, 0] = 100.0, 9e-7
    engine.declare_frame("bee", T)
    seen = Frame(0, 0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), Camera(8, 8, 4, 4, 8, 8), T)
    [moved] = engine.in_fused_frame([AgentKeyframe("bee", seen)])
    assert moved.frame.T_world_camera == pytest.approx(wrong_frame((200.47, 0.0, 0.0), 0.0), abs=1e-9)


def test_moved_gaussians_keep_their_shape() -> None:
    flat = replace(corner(0, count=10), scales_m=np.tile(np.float32([0.1, 0.01, 0.001]), (10, 1)))
    T = wrong_frame((1.0, 2.0, 3.0), 70.0)
    moved = move_gaussians(flat, T)
    assert moved.means_m == pytest.approx(transform_points(T, flat.means_m), abs=1e-5)
    # the x axis of each Gaussian turns with the frame
    w, x, y, z = moved.quats_wxyz.T.astype(np.float64)
    axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    assert axis == pytest.approx(np.tile(T[:3, 0], (10, 1)), abs=1e-5)


@pytest.mark.parametrize(("shift_m", "is_kept"), [(0.0, True), (0.05, True), (0.22, False)])
def test_an_earlier_map_in_another_frame_is_corrected_or_deleted(shift_m: float, is_kept: bool) -> None:
    engine = aligning()

    def reboot() -> str:
        return engine.join("ant", ANYTHING, fresh_map=True).session.session_id

    session = reboot()
    engine.contribute(session, RoiSubset("ant", "", 1, 1, group_by_voxel(corner(0), GRID)), GRID)
    session, whole = reboot(), group_by_voxel(move_gaussians(corner(1), wrong_frame((shift_m,) * 3)), GRID)
    for seq in (1, 2):
        part = select_voxels(whole, np.arange(len(whole)) % 2 == seq % 2)
        engine.contribute(session, RoiSubset("ant", "", seq, seq, part), GRID)
        engine.align_due()
    status = {each.agent_id: each for each in engine.status().agents}
    assert ("ant:1" in status) == is_kept
    assert status["ant"].alignment.state is not AlignmentState.QUARANTINED
    if not is_kept:
        assert status["ant"].won_voxels == status["ant"].voxels > 0


def test_what_a_comparison_keeps_of_a_map_is_in_the_memory_that_its_agent_may_take() -> None:
    engine = aligning(fit=lambda *_: None)
    floor = np.stack(np.meshgrid(np.arange(100), np.arange(100), range(3)), -1).reshape(-1, 3) * (0.1, 0.1, 0.02)
    for agent_id in ("ant", "bee"):
        send(engine, agent_id, plain_gaussians(floor + 0.01))
    tracemalloc.start()
    engine.align_due()
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert len(engine._aligner._maps["bee"].keys) > COMPARED_VOXELS / 2
    # beside what is kept of the two agents
    assert kept < 2 * COMPARED_VOXELS * COMPARED_BYTES + 100_000
