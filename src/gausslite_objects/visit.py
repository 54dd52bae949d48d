"""What one run knows of a place: its map, its objects, and the surface on which its depth images agree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import small_gicp
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera, back_project
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.frame import without_depth_edges
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import UpAxis, inverse, transform_points, unit_up_axis
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.free_space import REDUCED_WIDTH_PX, DepthView, view_counts
from gausslite_objects.keyframe_depths import read_keyframe_depths

GRID = VoxelGrid(0.05)
_MAX_DEPTH_M = 5.0
_DEPTH_EDGE_PX = 1
_MIN_PIXELS = 2
_COS_HALF_ANGLE = np.cos(np.radians(5.0))
"""Of the rays of two views that see one thin thing; with 7 degrees, halves of the kitchen have a false change."""
_MIN_OPACITY = 0.5
_MEASURED_GRID = VoxelGrid(0.025)
STAYS_M = 0.04
"""Distance to what a visit has measured within which a point is on that surface: errors of poses and depth."""
CLEAR_M = 0.07
"""Distance from which it is on no measured surface: errors of poses and depth are slivers along one."""
_BEHIND_M, _BEHIND_SHARE = 0.02, 0.01
"""A point farther from it is seen through if the depth behind it is farther by this."""
_NEIGHBOURS = np.ones((5, 5), np.uint8)
MIN_POINTS = 8
"""Points of an object below which nothing is said about it."""


@dataclass(frozen=True, eq=False)
class Visit:
    """One run's map and objects, and the reduced depth that its keyframes measured, with their capture times."""

    gaussians: Gaussians
    objects: Sequence[ObjectLandmark]
    views: Sequence[DepthView]
    times_ns: Sequence[int]

    @property
    def surface_m(self) -> Float32[ndarray, "n 3"]:
        """The mean of the measured points in each cell of 5 cm, without what the run's own views see through."""
        return self._surface[0]

    @property
    def is_repeated(self) -> Bool[ndarray, " n"]:
        """Whether more than one view has measured each point of the surface."""
        return self._surface[1]

    @cached_property
    def thin_m(self) -> Float32[ndarray, "n 3"]:
        """Points of the surfaces beside jumps of depth, where errors lie along the rays: from several sides only."""
        points_m, _, is_from_sides = self._cells(0)
        is_thin = is_from_sides & ~np.isin(GRID.keys(points_m), GRID.keys(self.surface_m))
        thin_m: Float32[ndarray, "n 3"] = points_m[is_thin]
        return thin_m

    @cached_property
    def _surface(self) -> tuple[Float32[ndarray, "n 3"], Bool[ndarray, " n"], Bool[ndarray, " n"]]:
        return self._cells(_DEPTH_EDGE_PX)

    def _cells(self, edge_px: int) -> tuple[Float32[ndarray, "n 3"], Bool[ndarray, " n"], Bool[ndarray, " n"]]:
        """Return the means of cells, which ones several views have measured, and which ones from several sides."""
        points = [_points(view, edge_px) for view in self.views]
        view_of = np.repeat(np.arange(len(points)), [len(own) for own in points])
        points_m = np.concatenate([np.zeros((0, 3), np.float32), *points])
        means_m, cell, count = _cell_means(points_m, GRID)
        seen, by = np.divmod(np.unique(cell * len(points) + view_of), max(len(points), 1))
        measured = np.bincount(seen, minlength=len(count))
        through, _ = view_counts(means_m.astype(np.float32), self.views)
        is_sure = (count >= _MIN_PIXELS) & ~is_empty(through, measured)
        eyes_m = np.reshape([inverse(view.T_camera_world)[:3, 3] for view in self.views], (-1, 3))
        rays = eyes_m[by] - means_m[seen]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        sums = np.stack([np.bincount(seen, weights=axis, minlength=len(count)) for axis in rays.T], axis=1)
        # the mean of two unit vectors is as long as the cosine of half of their angle
        is_from_sides = np.linalg.norm(sums, axis=1) <= _COS_HALF_ANGLE * measured
        return means_m[is_sure].astype(np.float32), measured[is_sure] > 1, is_from_sides[is_sure]

    @cached_property
    def _measured(self) -> small_gicp.KdTree | None:
        """All that the views measured, in cells of 2.5 cm; None for nothing."""
        cells_m = [_cell_means(_points(view, edge_px=0), _MEASURED_GRID)[0] for view in self.views]
        cells_m = [np.zeros((0, 3)), *cells_m]
        points_m = _cell_means(np.concatenate(cells_m).astype(np.float32), _MEASURED_GRID)[0]
        return small_gicp.KdTree(points_m, num_threads=1) if len(points_m) else None

    def distance_m(self, points_m: Float32[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return how far each point is from what the views measured; infinite if they measured nothing."""
        if self._measured is None or len(points_m) == 0:
            return np.full(len(points_m), np.inf)
        _, squares = self._measured.batch_nearest_neighbor_search(points_m.astype(np.float64), num_threads=1)
        distances_m: Float64[ndarray, " n"] = np.sqrt(np.asarray(squares, np.float64))
        return distances_m

    def verdicts(
        self, points_m: Float32[ndarray, "n 3"]
    ) -> Iterator[tuple[Bool[ndarray, " n"], Bool[ndarray, " n"], Bool[ndarray, " n"]]]:
        """Yield which points each view sees through, at which it shows a surface, and which it does not see."""
        is_far = self.distance_m(points_m) > STAYS_M
        for view in self.views:
            through, shown = view.classify(points_m)
            through |= is_far & view.sees_through(points_m, _BEHIND_M, _BEHIND_SHARE)
            yield through, shown & ~is_far, view.occludes(points_m)

    @cached_property
    def opaque(self) -> Gaussians:
        """The opaque Gaussians."""
        return self.gaussians.take(self.gaussians.opacities >= _MIN_OPACITY)

    @cached_property
    def _opaque_keys(self) -> Int64[ndarray, " n"]:
        return GRID.keys(self.opaque.means_m)

    def points_of(self, landmark: ObjectLandmark) -> Float32[ndarray, "n 3"]:
        """Return the means of the task's region in an object's box, or the surface there if these are few."""
        own = self.opaque.means_m[landmark.extent_m.contains(self.opaque.means_m) & self.opaque.active]
        if len(own) >= MIN_POINTS:
            own = own[near_cells(own, self.surface_m, 1)]
        else:
            own = self.surface_m[landmark.extent_m.contains(self.surface_m)]
        points_m: Float32[ndarray, "n 3"] = own
        return points_m

    def colour_of(self, points_m: Float32[ndarray, "n 3"]) -> Float32[ndarray, "3"] | None:
        """Return the mean colour of the Gaussians in the cells of these points; None if there are none."""
        rgb = self.opaque.rgb[np.isin(self._opaque_keys, GRID.keys(points_m))]
        if len(rgb) == 0:
            return None
        mean: Float32[ndarray, "3"] = rgb.mean(axis=0)
        return mean


def read_depths(folder: Path, keyframes: Sequence[KeyframeView]) -> dict[int, Float32[ndarray, "h w"]]:
    """Return the reduced depth images of a run. Raises MapFileError unless they have the sizes of their keyframes."""
    depths_m = read_keyframe_depths(folder)
    for view in keyframes:
        camera = view.camera.narrower(REDUCED_WIDTH_PX)
        size, depth_m = (camera.width_px, camera.height_px), depths_m.get(view.index)
        if depth_m is not None and depth_m.shape[::-1] != size:
            raise MapFileError(f"{folder}: expected depth of {size} pixels for keyframe {view.index}, got another size")
    return depths_m


def stated_up(report: Mapping[str, object]) -> UpAxis | None:
    """Return the upward direction in the map's frame; None if the report states none. Raises InvalidInputError."""
    if (stated := report.get("up")) is None:
        return None
    numbers = [value for value in stated if isinstance(value, int | float)] if isinstance(stated, list) else []
    if len(numbers) != 3:
        raise InvalidInputError(f"report.json: up: expected three numbers, got {stated!r}")
    return unit_up_axis((numbers[0], numbers[1], numbers[2]))


def depth_views(
    keyframes: Sequence[KeyframeView], depths_m: Mapping[int, Float32[ndarray, "h w"]]
) -> tuple[list[DepthView], list[int]]:
    """Return the views of the keyframes with a depth image, and their capture times."""
    seen = [view for view in keyframes if view.index in depths_m]
    views = [
        depth_view(depths_m[view.index], view.camera.narrower(REDUCED_WIDTH_PX), view.T_world_camera) for view in seen
    ]
    return views, [view.capture_time_ns for view in seen]


def depth_view(depth_m: Float32[ndarray, "h w"], camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> DepthView:
    """Return the view of a reduced depth image, with the nearest depth measured around each pixel that has one.

    Sensors miss single pixels of dark and glossy surfaces; beside each, nothing would be decided.
    """
    nearest_m = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), _NEIGHBOURS)
    view = DepthView.of(depth_m, camera, T_world_camera)
    return replace(view, nearest_m=np.where(depth_m > 0, nearest_m, np.float32(0.0)))


def is_empty(through: Int64[ndarray, " n"], shown: Int64[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return the points that views see through, at least twice as many as show a surface there.

    With two views instead of one, 7 of 12 changes in two simulated homes are found, not 12; halves of three recordings
    have no false one either way.
    """
    empty: Bool[ndarray, " n"] = (through > 0) & (through >= 2 * shown)
    return empty


def _points(view: DepthView, edge_px: int = _DEPTH_EDGE_PX) -> Float32[ndarray, "n 3"]:
    depth_m = without_depth_edges(view.depth_m, edge_px)
    points = back_project(depth_m, view.camera)[(depth_m > 0) & (depth_m <= _MAX_DEPTH_M)]
    points_m: Float32[ndarray, "n 3"] = transform_points(inverse(view.T_camera_world), points).astype(np.float32)
    return points_m


def _cell_means(
    points_m: Float32[ndarray, "n 3"], grid: VoxelGrid
) -> tuple[Float64[ndarray, "m 3"], Int64[ndarray, " n"], Int64[ndarray, " m"]]:
    """Return the mean of the points in each cell, the cell of each point, and the number of points in each."""
    _, cell, count = np.unique(grid.keys(points_m), return_inverse=True, return_counts=True)
    means_m = np.stack([np.bincount(cell, weights=axis) for axis in points_m.T], axis=1) / count[:, None]
    return means_m, cell, count


def cell_neighbours(radius: int) -> Int64[ndarray, " k"]:
    """Return the differences of a cell's key to those of all cells within this distance along each axis."""
    steps = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 3), axis=-1).reshape(-1, 3)
    centre_m = np.full((1, 3), 0.5 * GRID.size_m, np.float32)
    offsets: Int64[ndarray, " k"] = GRID.keys((centre_m + steps * GRID.size_m).astype(np.float32)) - GRID.keys(centre_m)
    return offsets


def near_cells(
    points_m: Float32[ndarray, "n 3"], others_m: Float32[ndarray, "m 3"], radius: int
) -> Bool[ndarray, " n"]:
    """Return the points with one of the others in a cell within this distance along each axis."""
    near = GRID.keys(points_m)[:, None] + cell_neighbours(radius)
    found: Bool[ndarray, " n"] = np.logical_or.reduce(np.isin(near, GRID.keys(others_m)), axis=1)
    return found


def near_boxes(
    objects: Iterable[ObjectLandmark], margin_m: float, points_m: Float32[ndarray, "n 3"]
) -> Bool[ndarray, " n"]:
    """Return the points in the objects' boxes, or within a margin of one."""
    inside: Bool[ndarray, " n"] = np.zeros(len(points_m), np.bool_)
    for landmark in objects:
        low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
        inside[((points_m >= low - margin_m) & (points_m <= high + margin_m)).all(axis=1)] = True
    return inside
