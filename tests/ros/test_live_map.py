"""Planar grids while a map grows: seen floor and air are free, obstacles of a height are occupied, the rest unknown."""

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.voxels import VoxelGrid, group_by_voxel
from gausslite_export.occupancy import FREE, OCCUPIED, UNKNOWN, FloorGrid, OccupancySettings
from gausslite_link.map_follower import FollowedMap
from gausslite_ros.live_map import LiveMap

CELL_M = 0.1
CAMERA = Camera.centred(80.0, 160, 120)
# a wall across x at 2 m, from the floor to 1 m, and a post farther away
WALL_M = [[2.05, y, z] for y in np.arange(-1.0, 1.0, 0.05) for z in np.arange(0.0, 1.0, 0.05)]
POST_M = [[3.55, 0.05, z] for z in np.arange(0.0, 1.0, 0.05)]
MAP = FollowedMap(1, group_by_voxel(plain_gaussians([*WALL_M, *POST_M], opacities=0.9), VoxelGrid(0.1)), {})


def forward_frame(depth_m: float) -> Frame:
    """Return a level image along x, half a metre above the floor."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[:3, 3] = 0.05, 0.05, 0.55
    depths_m = np.full((120, 160), depth_m, np.float32)
    depths_m[77:] = 0.0  # below the floor
    return Frame(0, 0, np.zeros((120, 160, 3), np.uint8), depths_m, CAMERA, T)


def at(grid: FloorGrid, x_m: float, y_m: float) -> int:
    column, row = (
        int(np.floor((value - low) / CELL_M + 1e-6)) for value, low in zip((x_m, y_m), grid.origin_m, strict=True)
    )
    return int(grid.cells[row, column])


def live_map(heights: tuple[tuple[float, float], ...]) -> LiveMap:
    return LiveMap(lambda: MAP, OccupancySettings(CELL_M), heights)


def test_what_a_frame_sees_through_is_free_and_what_it_does_not_is_unknown() -> None:
    live = live_map(((0.1, 0.9),))
    contents = live.update()
    assert contents is not None
    assert at(contents.grids[0], 2.05, 0.05) == OCCUPIED
    assert at(contents.grids[0], 2.45, 0.05) == UNKNOWN
    live.see(forward_frame(2.6), np.eye(4))  # past the wall, up to 2.5 m
    contents = live.update()
    assert contents is not None
    grid = contents.grids[0]
    assert [at(grid, x_m, 0.05) for x_m in (2.05, 2.35, 3.05, 3.55)] == [OCCUPIED, FREE, UNKNOWN, OCCUPIED]
    live.see(forward_frame(2.6), np.eye(4))
    contents = live.update()
    assert contents is not None
    assert at(contents.grids[0], 2.05, 0.05) == FREE  # two images see through what the map still has


def test_a_correction_of_the_odometry_moves_the_free_cells() -> None:
    live, T_map_odometry = live_map(((0.1, 0.9),)), np.eye(4)
    T_map_odometry[0, 3] = 0.5
    live.see(forward_frame(2.6), T_map_odometry)
    contents = live.update()
    assert contents is not None
    assert [at(contents.grids[0], x_m, 0.05) for x_m in (2.85, 3.25)] == [FREE, UNKNOWN]


def test_each_range_of_heights_has_its_obstacles() -> None:
    contents = live_map(((0.1, 0.9), (1.2, 1.8))).update()
    assert contents is not None
    assert [OCCUPIED in grid.cells for grid in contents.grids] == [True, False]


def test_before_the_agent_has_a_map_there_are_no_messages() -> None:
    assert LiveMap(lambda: None, OccupancySettings(CELL_M), ((0.1, 0.9),)).update() is None


def test_one_gaussian_far_away_does_not_end_the_grids() -> None:
    points_m = [*WALL_M, [9e4, 0.0, 0.5]]
    far = FollowedMap(1, group_by_voxel(plain_gaussians(points_m, opacities=0.9), VoxelGrid(0.1)), {})
    contents = LiveMap(lambda: far, OccupancySettings(CELL_M), ((0.1, 0.9),)).update()
    assert contents is not None
    assert at(contents.grids[0], 2.05, 0.05) == OCCUPIED
