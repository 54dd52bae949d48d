"""What planners need of the agent's map while it grows: the task's region and planar grids with free cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.free_space import DepthView
from gausslite_export.occupancy import FloorGrid, OccupancySettings, near_middle, occupied_voxels, planar_grid
from gausslite_export.surface_votes import SurfaceVotes
from gausslite_link.map_follower import FollowedMap

_MAX_VOXELS = 1 << 22
Heights = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class MapContents:
    """All Gaussians, those of the task's region, and a grid for each range of heights."""

    gaussians: Gaussians
    region: Gaussians
    grids: tuple[FloorGrid, ...]


class LiveMap:
    """Owns what the depth images of a mission show. `see` and `update` may be called in different threads.

    newest_map: the agent's map. heights: the lowest and highest obstacle above the floor, of each grid. A voxel is
    occupied by a surface of the images, or by a Gaussian unless two images see through it.
    """

    def __init__(self, newest_map: Callable[[], FollowedMap | None], settings: OccupancySettings, heights: Heights):
        self._newest_map, self._settings, self._heights = newest_map, settings, heights
        # further voxels are not counted: a mission that large needs larger cells
        self._votes = SurfaceVotes(settings.voxel_m, _MAX_VOXELS)
        self._seen: Frame | None = None

    def see(self, frame: Frame, T_map_odometry: Float64[ndarray, "4 4"] | None) -> None:
        """Keep the newest frame for the next update; None: before the agent has mapped a frame."""
        if T_map_odometry is not None:
            self._seen = replace(frame, T_world_camera=T_map_odometry @ frame.T_world_camera)

    def update(self) -> MapContents | None:
        """Count what the newest frame shows; return the map, None before the agent has one."""
        seen, self._seen = self._seen, None
        if seen is not None:
            self._votes.add(DepthView.reduced(seen))
        newest = self._newest_map()
        if newest is None or not len(newest.batch.gaussians):
            return None
        gaussians = newest.batch.gaussians
        # those of a teammate, or of a wrong measurement, may be anywhere
        voxels = occupied_voxels(gaussians.take(near_middle(gaussians, gaussians)[0]), self._settings)
        if not len(voxels):
            return None
        voxels = self._votes.without_contradicted(voxels)
        free = self._votes.free(voxels)
        return MapContents(
            gaussians,
            gaussians.take(gaussians.active),
            tuple(planar_grid(voxels, free, replace(self._settings, height_m=range_m)) for range_m in self._heights),
        )
