"""Frames of a team: a misfit is measured and corrected, a gross one is quarantined with a message."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.free_space import FreeSpace, split_indices
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, transform_points
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.fusion.alignment import SurfaceSamples, fit_frame
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentSettings, AlignmentState
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore, MissionConfig

GRID = VoxelGrid(0.10)
ANYTHING = MissionConfig("", "", 0.10)
SETTINGS = FusionSettings(grid=GRID, alignment=AlignmentSettings())


def corner(seed: int, kappa: int = 5, count: int = 3000) -> Gaussians:
    """Samples of a textured corner of a room: a floor and two walls of 2 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 2, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0.0
    texture = 0.5 + 0.4 * np.sin(6 * points[:, 0] + 4 * points[:, 1] + 5 * points[:, 2])
    return plain_gaussians(
        points + rng.normal(0, 0.002, points.shape), rgb=np.repeat(texture[:, None], 3, 1), kappa=kappa
    )


def wrong_frame(shift_m: tuple[float, float, float], angle_deg: float = 0.0) -> np.ndarray:
    axis = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    return transform_of(np.array([*shift_m, *(np.radians(angle_deg) * axis)]))


def send(engine: FusionEngine, agent_id: str, gaussians: Gaussians, seq: int = 1) -> None:
    session = engine.join(agent_id, ANYTHING).session.session_id
    engine.contribute(session, RoiSubset(agent_id, "", seq, seq, group_by_voxel(gaussians, GRID)), GRID)


def team(T_agent_fused: np.ndarray, store: FusionStore | None = None) -> FusionEngine:
    """An engine with ant, in the fused frame, and bee, whose frame is wrong and whose kappa wins."""
    engine = FusionEngine(store or MemoryStore(), SETTINGS)
    send(engine, "ant", corner(0))
    send(engine, "bee", move_gaussians(corner(1, kappa=9), T_agent_fused))
    return engine


def state_of(engine: FusionEngine, agent_id: str) -> AlignmentState:
    return next(each.alignment.state for each in engine.status().agents if each.agent_id == agent_id)


def surface_error_m(points_m: np.ndarray) -> float:
    """Return the median distance of points to the corner's planes."""
    return float(np.median(np.abs(points_m).min(axis=1)))


@pytest.mark.parametrize(
    ("shift_m", "angle_deg"), [((0.0, 0.0, 0.0), 0.0), ((0.03, -0.03, 0.025), 2.0), ((0.1, 0.0, 0.1), 3.0)]
)
def test_the_fit_recovers_a_misfit(shift_m: tuple[float, float, float], angle_deg: float) -> None:
    T_agent_fused = wrong_frame(shift_m, angle_deg)
    fit = fit_frame(move_gaussians(corner(1), T_agent_fused), SurfaceSamples.of(corner(0)), np.eye(4))
    assert fit is not None
    error = fit.T_fused_agent @ T_agent_fused
    assert np.linalg.norm(transform_points(error, np.ones((1, 3))) - 1.0) < 0.01
    assert rotation_angle_deg(error, np.eye(4)) < 0.3
    assert fit.after.distance_m < 0.005


def test_too_few_samples_give_no_fit() -> None:
    assert fit_frame(corner(1, count=30), SurfaceSamples.of(corner(0)), np.eye(4)) is None
    far = move_gaussians(corner(1), wrong_frame((50.0, 0.0, 0.0)))
    assert fit_frame(far, SurfaceSamples.of(corner(0)), np.eye(4)) is None


def test_a_frame_within_the_noise_changes_no_bit() -> None:
    engine = team(np.eye(4))
    before = engine.maps.voted_map()
    assert not engine.align_due()
    assert (state_of(engine, "ant"), state_of(engine, "bee")) == (AlignmentState.REFERENCE, AlignmentState.ALIGNED)
    assert engine.maps.voted_map().gaussians.means_m.tobytes() == before.gaussians.means_m.tobytes()


def test_five_centimetres_and_two_degrees_are_corrected_also_after_a_restart(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite")
    engine = team(wrong_frame((0.03, -0.03, 0.025), 2.0), store)
    wrong = surface_error_m(engine.maps.voted_map("bee").gaussians.means_m)
    revision = engine.revision
    assert engine.align_due()
    assert not engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    corrected = surface_error_m(engine.maps.voted_map("bee").gaussians.means_m)
    assert wrong > 0.015
    assert corrected < 0.005
    assert engine.revision > revision
    # a watcher that follows the changes has the map of a new watcher
    assert len(engine.maps.changes(revision).won.batch) > 0
    store.close()
    store = SqliteStore(tmp_path / "store.sqlite")
    assert surface_error_m(FusionEngine(store, SETTINGS).maps.voted_map("bee").gaussians.means_m) == corrected
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
    [
        box_on_table(1),
        table_part(1, 0.55, 1.0),
        np.vstack([box_on_table(1), table_part(1, 0.45, 0.8)]),
    ],
    ids=["a box on the table", "another part of the table", "box and another part"],
)
def test_correct_frames_of_regions_that_hardly_overlap_stay_as_they_are(points: np.ndarray) -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", plain_gaussians(table_part(0, 0.0, 0.5), kappa=5))
    for seq in range(1, 5):
        send(engine, "bee", plain_gaussians(points[: seq * len(points) // 4], kappa=9), seq)
        engine.align_due()
        assert state_of(engine, "bee") in (AlignmentState.UNKNOWN, AlignmentState.ALIGNED)


def test_a_gross_misfit_is_quarantined_with_a_message_and_returns_when_it_is_mended() -> None:
    engine = team(wrong_frame((0.25, 0.25, 0.2)))
    assert len(engine.maps.voted_map("bee")) > 0
    assert engine.align_due()
    [bee] = [each for each in engine.status().agents if each.agent_id == "bee"]
    assert bee.alignment.state is AlignmentState.QUARANTINED
    assert "check the agent's localisation" in bee.alignment.message
    assert bee.gaussians > 0
    assert bee.won_voxels == 0
    assert {each.agent_id for each in engine.status().agents if each.won_voxels} == {"ant"}
    seen = Frame(0, 0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), Camera(8, 8, 4, 4, 8, 8), np.eye(4))
    kept = engine.in_fused_frame([AgentKeyframe("ant", seen), AgentKeyframe("bee", seen)])
    assert [each.agent_id for each in kept] == ["ant"]
    send(engine, "bee", corner(1, kappa=9), seq=2)
    engine.align_due()
    assert state_of(engine, "bee") is not AlignmentState.QUARANTINED


def observe_free(engine: FusionEngine, agent_id: str, low: int, high: int, views: int = 2) -> None:
    """This many views of the agent have seen every voxel of the cube low <= i, j, k < high as free."""
    indices = np.stack(np.meshgrid(*[np.arange(low, high)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    blocks, cells = split_indices(indices, GRID)
    keys, rows = np.unique(blocks, return_inverse=True)
    counts = np.zeros((len(keys), 512), np.uint8)
    counts[rows, cells] = views
    session = engine.join(agent_id, ANYTHING).session.session_id
    engine.contribute_free_space(session, FreeSpace(keys, counts), GRID)


def small_object(centre_m: tuple[float, float, float]) -> Gaussians:
    return plain_gaussians(np.random.default_rng(3).uniform(-0.1, 0.1, (80, 3)) + centre_m, kappa=9)


@pytest.mark.parametrize("free_space_comes_first", [True, False])
def test_a_region_without_overlap_in_free_space_is_quarantined_and_returns(free_space_comes_first: bool) -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", small_object((0.0, 0.0, 0.0)))
    if free_space_comes_first:
        observe_free(engine, "ant", 5, 15)
    send(engine, "bee", small_object((1.0, 1.0, 1.0)))
    if not free_space_comes_first:
        engine.align_due()
        assert state_of(engine, "bee") is AlignmentState.UNKNOWN
        observe_free(engine, "ant", 5, 15)
    assert engine.align_due()
    [bee] = [each for each in engine.status().agents if each.agent_id == "bee"]
    assert bee.alignment.state is AlignmentState.QUARANTINED
    assert "observed free space" in bee.alignment.message
    assert bee.won_voxels == 0
    # the same voxels without an observation
    observe_free(engine, "ant", 5, 15, views=0)
    assert engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.UNKNOWN
    assert len(engine.maps.voted_map("bee")) > 0


def test_stray_gaussians_in_free_space_do_not_quarantine_a_correct_frame() -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", small_object((0.0, 0.0, 0.0)))
    observe_free(engine, "ant", 5, 15)
    # a large surface that ant has not seen, and stray Gaussians that have many voxels of free space to themselves
    strays = plain_gaussians(np.random.default_rng(4).uniform(0.5, 1.5, (60, 3)))
    send(engine, "bee", Gaussians.concatenate([corner(1, kappa=9, count=3000), strays]))
    engine.align_due()
    assert state_of(engine, "bee") is not AlignmentState.QUARANTINED


def test_an_agents_own_free_space_is_no_evidence_against_it() -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", small_object((0.0, 0.0, 0.0)))
    send(engine, "bee", small_object((1.0, 1.0, 1.0)))
    observe_free(engine, "bee", 5, 15)
    engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.UNKNOWN


def test_later_updates_of_a_drifting_agent_get_their_own_correction() -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", corner(0))
    scene = corner(1, kappa=9)
    order = np.argsort(scene.means_m[:, 0], kind="stable")
    for seq, rows in enumerate(np.array_split(order, 4), start=1):
        drift = wrong_frame((0.0, 0.02 * seq, 0.02 * seq), 0.5 * seq)
        send(engine, "bee", move_gaussians(scene.take(rows), drift), seq)
        engine.align_due()
    [bee] = [each for each in engine.status().agents if each.agent_id == "bee"]
    assert bee.alignment.state is AlignmentState.CORRECTED
    assert len(bee.alignment.segments) > 1
    assert surface_error_m(engine.maps.voted_map("bee").gaussians.means_m) < 0.01


def test_a_declared_frame_is_used_and_can_be_refined() -> None:
    T_agent_fused = wrong_frame((5.0, 0.0, 0.0), 40.0)
    engine = FusionEngine(MemoryStore(), SETTINGS)
    send(engine, "ant", corner(0))
    engine.join("bee", ANYTHING)
    engine.declare_frame("bee", wrong_frame((0.02, 0.02, 0.0)) @ inverse(T_agent_fused))
    send(engine, "bee", move_gaussians(corner(1, kappa=9), T_agent_fused))
    engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    assert surface_error_m(engine.maps.voted_map("bee").gaussians.means_m) < 0.005


def test_a_keyframe_that_a_declared_frame_moves_out_of_range_is_left_out() -> None:
    engine = FusionEngine(MemoryStore(), SETTINGS)
    engine.join("bee", ANYTHING)
    engine.declare_frame("bee", wrong_frame((9000.0, 0.0, 0.0)))
    near, far = (
        Frame(0, 0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), Camera(8, 8, 4, 4, 8, 8), T)
        for T in (np.eye(4), wrong_frame((5000.0, 0.0, 0.0)))
    )
    [moved] = engine.in_fused_frame([AgentKeyframe("bee", near), AgentKeyframe("bee", far)])
    assert moved.frame.T_world_camera[0, 3] == 9000.0


def test_moved_gaussians_keep_their_shape() -> None:
    flat = replace(corner(0, count=10), scales_m=np.tile(np.float32([0.1, 0.01, 0.001]), (10, 1)))
    T = wrong_frame((1.0, 2.0, 3.0), 70.0)
    moved = move_gaussians(flat, T)
    assert moved.means_m == pytest.approx(transform_points(T, flat.means_m), abs=1e-5)
    # the x axis of each Gaussian turns with the frame
    w, x, y, z = moved.quats_wxyz.T.astype(np.float64)
    axis = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    assert axis == pytest.approx(np.tile(T[:3, 0], (10, 1)), abs=1e-5)
