"""Depth behind a point contradicts it; contradicted Gaussians leave a continued map, as tombstones in the team."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.voxels import VoxelGrid, group_by_voxel
from gausslite.mapping.free_space import DepthView, has_guessed_depth, seen_through, view_counts, without_guesses
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, OptimizationSettings
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.render.cpu import CpuRasterizer

WALL_M = 2.0
GHOST_M = np.array([[0.02 * i, 0.0, 1.4] for i in range(6)], np.float32)


def _view(depth_m: np.ndarray | None = None) -> DepthView:
    frame = wall_frame()
    return DepthView.of_frame(frame if depth_m is None else replace(frame, depth_m=depth_m))


def test_a_view_sees_through_points_before_its_surface_and_decides_nothing_else() -> None:
    z_m = np.array([1.5, 1.93, 1.97, 2.03, 2.07, 3.0, -1.0], np.float32)
    through, shown = _view().classify(np.stack([0 * z_m, 0 * z_m, z_m], axis=1))
    assert through.tolist() == [True, False, False, False, False, False, False]
    assert shown.tolist() == [False, False, True, True, False, False, False]


def test_nothing_is_decided_beside_unmeasured_pixels_and_outside_the_image() -> None:
    depth_m = wall_frame().depth_m.copy()
    depth_m[24, 32] = 0.0
    points_m = np.array([[0.03, 0.03, 1.5], [5.0, 0.0, 1.5]], np.float32)
    assert not np.any(_view(depth_m).classify(points_m))


def test_a_point_at_a_jump_of_depth_counts_as_shown() -> None:
    depth_m = wall_frame().depth_m.copy()
    depth_m[:, :32] = 1.5
    point_m = np.array([[0.02, 0.0, 1.5]], np.float32)  # a pixel right of the jump
    through, shown = _view(depth_m).classify(point_m)
    assert (through[0], shown[0]) == (False, True)


@pytest.mark.parametrize(
    ("through", "shown", "contradicted"), [(2, 0, False), (3, 0, True), (3, 1, True), (3, 2, False)]
)
def test_three_views_contradict_a_point_unless_others_show_it(through: int, shown: int, contradicted: bool) -> None:
    point_m = np.array([[0.0, 0.0, 1.5]], np.float32)
    views = [_view()] * through + [_view(np.full_like(wall_frame().depth_m, 1.5))] * shown
    assert [int(counts[0]) for counts in view_counts(point_m, views)] == [through, shown]
    assert seen_through(point_m, views).tolist() == [contradicted]


def test_a_distant_point_at_an_unmeasured_pixel_is_a_guess_unless_another_frame_measures_it_or_comes_near() -> None:
    depth_m = np.full_like(wall_frame().depth_m, 5.0)
    depth_m[:, 32:] = 0.0
    hole = replace(wall_frame(), depth_m=depth_m)
    points_m = np.array([[1.0, 0.0, 5.0], [-1.0, 0.0, 5.0], [-1.0, 0.0, 7.0], [1.0, 0.0, 3.9]], np.float32)
    assert has_guessed_depth(points_m, [hole]).tolist() == [True, False, False, False]
    measured = replace(wall_frame(), depth_m=np.full_like(depth_m, 5.0))
    near = replace(hole, T_world_camera=np.array([[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 1.5], [0, 0, 0, 1.0]]))
    for frames in ([hole, measured], [measured, hole], [hole, near], [near, hole], []):
        assert not has_guessed_depth(points_m, frames).any()


def test_only_untrained_guesses_are_kept_from_others() -> None:
    distant_m = np.array([[1.0, 0.1 * i, 5.0] for i in range(-2, 3)], np.float32)
    mapper = _continued(plain_gaussians(distant_m, kappa=[0, 0, 0, 0, 1], active=False))
    frame = wall_frame()
    depth_m = frame.depth_m.copy()
    depth_m[:, 32:] = 0.0
    no_relevance = RelevanceMap(np.zeros(depth_m.shape, np.float32), np.full(depth_m.shape, -1, np.int16))
    map_frame(mapper, replace(frame, depth_m=depth_m), no_relevance)
    whole = mapper.gaussians()
    shared = without_guesses(whole, (keyframe.frame for keyframe in mapper.store.kept))
    assert len(whole) - len(shared) == 4
    assert np.count_nonzero(shared.means_m[:, 2] > 4.5) == 1


def _continued(prior: Gaussians | None) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=2000,
        keyframes=KeyframeSettings(every=1),
        optimization=OptimizationSettings(warmup_iterations=1, active_iterations=1),
    )
    return GaussianMapper(settings, CpuRasterizer(threads=1), initial_map=prior)


def _prior() -> Gaussians:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.8, 0.8, 20), np.linspace(-0.6, 0.6, 16)))
    wall_m = np.stack([x, y, np.full(len(x), WALL_M)], axis=1)
    return plain_gaussians(np.concatenate([wall_m, GHOST_M]), kappa=7, active=True)


def _map(mapper: GaussianMapper, frames: int) -> None:
    for index in range(frames):
        frame = wall_frame(index, shift_m=0.05 * index)
        map_frame(
            mapper,
            frame,
            RelevanceMap(np.ones(frame.depth_m.shape, np.float32), np.zeros(frame.depth_m.shape, np.int16)),
        )


def _ghosts(gaussians: Gaussians) -> int:
    return int(np.count_nonzero(gaussians.means_m[:, 2] < 1.7))


def test_keyframes_remove_what_they_see_through_and_keep_the_rest() -> None:
    mapper = _continued(_prior())
    _map(mapper, 2)
    assert _ghosts(mapper.gaussians()) == len(GHOST_M)
    _map(mapper, 5)
    assert _ghosts(mapper.gaussians()) == 0
    assert np.count_nonzero(mapper.gaussians().kappa >= 7) > 200


def test_a_new_map_removes_nothing() -> None:
    mapper = _continued(None)
    _map(mapper, 1)
    grid = VoxelGrid()
    mapper.insert_team_voxels(group_by_voxel(plain_gaussians(GHOST_M, kappa=7), grid), grid)
    _map(mapper, 5)
    assert _ghosts(mapper.gaussians()) == len(GHOST_M)


def test_removed_gaussians_become_tombstones() -> None:
    mapper, tracker = _continued(_prior()), SentVoxelTracker(VoxelGrid())
    sent = tracker.collect_changes(mapper.gaussians(active_only=True))
    _map(mapper, 5)
    changes = tracker.collect_changes(mapper.gaussians(active_only=True))
    ghosts = np.unique(VoxelGrid().keys(GHOST_M))
    assert np.isin(ghosts, sent.keys).all()
    assert set(ghosts) <= set(changes.keys[changes.counts == 0])


def test_a_restored_map_goes_on_removing() -> None:
    first, second = _continued(_prior()), _continued(None)
    _map(first, 2)
    second.restore(first.state())
    for mapper in (first, second):
        _map(mapper, 5)
    assert second.gaussians().means_m.tobytes() == first.gaussians().means_m.tobytes()
    assert _ghosts(second.gaussians()) == 0
