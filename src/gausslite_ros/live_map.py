"""What planners need of the agent's map while it grows: the task's region and planar grids with free cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64, Int8, Int64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelGrid
from gausslite_export.free_cells import points_before_surface
from gausslite_export.occupancy import OccupancySettings, occupied_voxels, planar_grid
from gausslite_link.map_follower import FollowedMap

_WIDTH_PX = 80
_RANGE_M = 5.0
"""Of the rays that free cells: depth cameras see less well beyond it, and the rays lie a cell apart there."""
_MAX_FREE = 1 << 22
Heights = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells by y and x, with the values of nav_msgs/OccupancyGrid. origin_m: the lowest x and y."""

    cells: Int8[ndarray, "h w"]
    origin_m: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class MapContents:
    """All Gaussians, those of the task's region, and a grid for each range of heights."""

    gaussians: Gaussians
    region: Gaussians
    grids: tuple[Grid, ...]


class LiveMap:
    """Owns the free voxels of a mission. `see` and `update` may be called in different threads.

    newest_map: the agent's map. heights: the lowest and highest obstacle above the floor, of each grid. A voxel is free
    if a ray of a depth image crossed it and no Gaussian is in it: what has moved away stays occupied until the mapper
    removes it.
    """

    def __init__(self, newest_map: Callable[[], FollowedMap | None], settings: OccupancySettings, heights: Heights):
        self._newest_map, self._settings, self._heights = newest_map, settings, heights
        self._grid = VoxelGrid(settings.voxel_m)
        self._free: Int64[ndarray, " f"] = np.zeros(0, np.int64)
        self._seen: tuple[Frame, Float64[ndarray, "4 4"]] | None = None

    def see(self, frame: Frame, T_map_odometry: Float64[ndarray, "4 4"] | None) -> None:
        """Keep the newest frame for the next update; None: before the agent has mapped a frame."""
        if T_map_odometry is not None:
            self._seen = frame, T_map_odometry @ frame.T_world_camera

    def update(self) -> MapContents | None:
        """Free what the newest frame sees through; return the map, None before the agent has one."""
        self._carve()
        newest = self._newest_map()
        if newest is None or not len(newest.batch.gaussians):
            return None
        gaussians = newest.batch.gaussians
        voxels = occupied_voxels(gaussians, self._settings)
        if not len(voxels):
            return None
        free = self._grid.indices(self._free)
        return MapContents(
            gaussians,
            gaussians.take(gaussians.active),
            tuple(self._planar(voxels, free, replace(self._settings, height_m=range_m)) for range_m in self._heights),
        )

    def _carve(self) -> None:
        seen, self._seen = self._seen, None
        if seen is None:
            return
        frame, T_map_camera = seen
        camera = frame.camera.narrower(_WIDTH_PX)
        size = camera.width_px, camera.height_px
        depth_m = np.minimum(cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32(_RANGE_M))
        rays = points_before_surface(camera, depth_m, T_map_camera, self._settings.voxel_m)
        found = [np.unique(self._grid.keys(points_m.astype(np.float32))) for points_m in rays]
        # the oldest keys have no place of their own: a mission that large needs larger cells
        self._free = np.unique(np.concatenate([self._free, *found]))[:_MAX_FREE]

    def _planar(self, voxels: Int64[ndarray, "v 3"], free: Int64[ndarray, "f 3"], settings: OccupancySettings) -> Grid:
        cells, first = planar_grid(voxels, free, settings)
        x_m, y_m = (first * settings.voxel_m).tolist()
        return Grid(cells, (x_m, y_m))
