"""Gaussians follow their keyframes: what moves, what stays, and which voxels are then sent."""

from dataclasses import replace

import numpy as np
from mapping_scenes import middle_relevance, wall_frame
from sample_gaussians import random_gaussians

from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, transform_of
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.anchors import move_with_anchors
from gausslite.mapping.density import densify
from gausslite.mapping.keyframe_store import KeyframeStore
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.seeding import Seeds, insert_seeds
from gausslite.mapping.settings import DensitySettings, KeyframeSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mapping.window_view import window_view
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, MEAN, QUAT

MOTION = transform_of(np.array([0.5, -0.2, 0.1, 0.3, -0.4, 0.2]))
MOTIONS = np.array([np.eye(4), MOTION])


def gaussians(count: int, active: bool, rng: np.random.Generator) -> Gaussians:
    return replace(random_gaussians(count, int(rng.integers(1000))), active=np.full(count, active))


def anchored_table(rng: np.random.Generator) -> SplatTable:
    """Return 20 Gaussians each that follow no keyframe, keyframe 0 and keyframe 1, with random moments."""
    table = SplatTable(100)
    for anchor in (NO_ANCHOR, 0, 1):
        table.append(gaussians(20, True, rng), anchor)
    table.first_moment[:] = rng.normal(0, 1e-3, table.first_moment.shape)
    table.second_moment[:] = np.square(table.first_moment) * 1.5
    return table


def test_gaussians_move_with_their_keyframe_and_no_others_do() -> None:
    table = anchored_table(np.random.default_rng(0))
    before, rows, follows = table.to_gaussians(), table.rows.copy(), table.anchor == 1
    assert move_with_anchors(table, MOTIONS) == 20
    np.testing.assert_array_equal(table.rows[~follows], rows[~follows])
    moved, expected = table.to_gaussians(), move_gaussians(before.take(follows), MOTION)
    np.testing.assert_allclose(moved.means_m[follows], expected.means_m, atol=1e-5)
    aligned = np.abs(np.sum(moved.quats_wxyz[follows] * expected.quats_wxyz, axis=1))
    np.testing.assert_allclose(aligned, 1.0, atol=1e-5)
    np.testing.assert_array_equal(moved.scales_m, before.scales_m)
    np.testing.assert_array_equal(table.ema_rows[:, MEAN], table.rows[:, MEAN])


def test_adams_state_turns_with_the_gaussians_and_stays_valid() -> None:
    table = anchored_table(np.random.default_rng(1))
    first, follows = table.first_moment.copy(), table.anchor == 1
    move_with_anchors(table, MOTIONS)
    turned = first[follows, MEAN] @ MOTION[:3, :3].T
    np.testing.assert_allclose(table.first_moment[follows, MEAN], turned, atol=1e-8)
    lengths = np.linalg.norm(table.first_moment[:, QUAT], axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(first[:, QUAT], axis=1), rtol=1e-5)
    assert (table.second_moment >= 0).all()
    SplatTable(100).restore(table.state())


def test_a_motion_back_restores_the_map() -> None:
    table = anchored_table(np.random.default_rng(2))
    rows = table.rows.copy()
    move_with_anchors(table, MOTIONS)
    move_with_anchors(table, np.array([np.eye(4), inverse(MOTION)]))
    np.testing.assert_allclose(table.rows, rows, atol=1e-5)


def test_without_a_motion_no_bit_changes() -> None:
    table = anchored_table(np.random.default_rng(3))
    before = {name: column.copy() for name, column in table.state().items()}
    assert move_with_anchors(table, np.array([np.eye(4), np.eye(4)])) == 0
    for name, column in table.state().items():
        np.testing.assert_array_equal(column, before[name])


def test_seeds_get_the_anchor_of_their_frame_and_children_inherit_it() -> None:
    rng = np.random.default_rng(4)
    table = SplatTable(40)
    insert_seeds(table, Seeds(gaussians(8, True, rng), gaussians(8, False, rng), 3), 0.5, rng)
    insert_seeds(table, Seeds(Gaussians.empty(), gaussians(8, False, rng), 4), 0.5, rng)
    assert sorted(table.anchor.tolist()) == [3] * 16 + [4] * 8
    table.target[:] = table.anchor
    table.first_moment[:, GRAD_2D_SUM] = table.first_moment[:, GRAD_2D_COUNT] = 1.0
    densify(table, DensitySettings(min_mean_gradient=0.5, max_growth=1.0), 1.0)
    assert table.count > 24
    np.testing.assert_array_equal(table.anchor, table.target)


def test_moved_voxels_are_sent_once_and_their_old_places_become_tombstones() -> None:
    table = SplatTable(10)
    still, moving = (gaussians(4, True, np.random.default_rng(5)), gaussians(3, True, np.random.default_rng(6)))
    for anchor, placed in enumerate((still, moving)):
        placed.means_m[:] = (0.05 + 2.0 * anchor, 0.05, 0.05)
        table.append(placed, anchor)
    tracker = SentVoxelTracker(VoxelGrid(0.1))
    assert len(tracker.collect_changes(table.to_gaussians())) == 2
    move_with_anchors(table, np.array([np.eye(4), transform_of(np.array([0.5, 0, 0, 0, 0, 0]))]))
    changes = tracker.collect_changes(table.to_gaussians())
    assert sorted(changes.counts.tolist()) == [0, 3]
    assert len(tracker.collect_changes(table.to_gaussians())) == 0


def test_keyframes_and_poses_move_with_their_anchors() -> None:
    settings = KeyframeSettings(every=2)
    store, history, rasterizer = KeyframeStore(settings), PoseTable(), CpuRasterizer(1)
    for index in range(4):
        frame = wall_frame(index)
        history.add(frame, store.next_anchor)
        history.refine(frame.id, frame.T_world_camera)
        keyframe = Keyframe(frame, middle_relevance(frame), anchor=store.next_anchor)
        store.add(window_view(keyframe, rasterizer, settings))
    before = {keyframe.frame.index: keyframe.frame.T_world_camera for keyframe in store.kept}
    store.move(MOTIONS)
    history.move(MOTIONS)
    for view in store.window:
        index = view.keyframe.frame.index
        expected = MOTIONS[index // 2] @ before[index]
        np.testing.assert_allclose(view.keyframe.frame.T_world_camera, expected, atol=1e-9)
        np.testing.assert_allclose(view.T_camera_world, inverse(expected), atol=1e-9)
        np.testing.assert_allclose(history.trajectory().T_world_camera[index], expected, atol=1e-9)
