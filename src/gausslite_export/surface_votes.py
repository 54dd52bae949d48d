"""Count in how many depth images each voxel shows a surface, and in how many a camera sees through it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera, back_project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.free_space import REDUCED_WIDTH_PX, DepthView
from gausslite_export.mesh import Render

_RAY_WIDTH_PX = 80
_RANGE_M = 5.0
"""Depth cameras see less well beyond it, and the rays lie more than a cell of 5 cm apart."""
_MARGIN_VOXELS = 1.0
"""Rays end this far before the surface, whose depth is an average over its thickness."""
_MIN_IMAGES = 2
_MIN_RATIO = 0.2
"""A surface is what one image shows and none sees through, or what at least two images show and at least one of five
that see it or through it: of a thin leg or a leaf most images show what is behind. Errors at the edges of things lie
elsewhere in each image."""
_MAX_VOXELS = 1 << 25


class SurfaceVotes:
    """Owns the counts of each voxel that an image has shown. most_voxels: further ones are not counted."""

    def __init__(self, voxel_m: float, most_voxels: int = _MAX_VOXELS) -> None:
        self._grid, self._most_voxels = VoxelGrid(voxel_m), most_voxels
        self._keys: Int64[ndarray, " v"] = np.zeros(0, np.int64)
        # rows: images that show a surface in the voxel, and that see through it
        self._counts: Int32[ndarray, "2 v"] = np.zeros((2, 0), np.int32)

    @property
    def is_full(self) -> bool:
        """True once voxels have been left out."""
        return len(self._keys) >= self._most_voxels

    def add(self, view: DepthView) -> None:
        """Count a depth image. A voxel of one of its surfaces is not seen through in the same image."""
        T_world_camera, depth_m = inverse(view.T_camera_world), view.depth_m
        points_m = back_project(depth_m, view.camera)[(depth_m > 0) & (depth_m <= _RANGE_M)]
        shown = np.unique(self._grid.keys(transform_points(T_world_camera, points_m).astype(np.float32)))
        camera = view.camera.narrower(_RAY_WIDTH_PX)
        size = camera.width_px, camera.height_px
        ray_depth_m = np.minimum(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32(_RANGE_M))
        rays = points_before_surface(camera, ray_depth_m, T_world_camera, self._grid.size_m)
        crossed = [np.unique(self._grid.keys(points_m.astype(np.float32))) for points_m in rays]
        through = np.setdiff1d(np.concatenate([np.zeros(0, np.int64), *crossed]), shown)
        self._count(shown, through)

    def surface(self) -> Int64[ndarray, "v 3"]:
        """Return the indices of the voxels with a surface, sorted."""
        return self._grid.indices(self._keys[self._is_surface()])

    def free(self, occupied: Int64[ndarray, "n 3"] | None = None) -> Int64[ndarray, "f 3"]:
        """Return the indices of the voxels that an image sees through, sorted, without those with a surface.

        occupied: voxels that are not free either.
        """
        free = self._keys[self._is_free(1)]
        return self._grid.indices(free if occupied is None else np.setdiff1d(free, self._keys_of(occupied)))

    def without_contradicted(self, voxels: Int64[ndarray, "n 3"]) -> Int64[ndarray, "m 3"]:
        """Return these voxels and those with a surface, without what at least two images see through."""
        keys = np.setdiff1d(self._keys_of(voxels), self._keys[self._is_free(_MIN_IMAGES)])
        return self._grid.indices(np.union1d(keys, self._keys[self._is_surface()]))

    def _keys_of(self, voxels: Int64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
        return self._grid.keys(((voxels + 0.5) * self._grid.size_m).astype(np.float32))

    def _is_free(self, min_images: int) -> Bool[ndarray, " v"]:
        found: Bool[ndarray, " v"] = (self._counts[1] >= min_images) & ~self._is_surface()
        return found

    def _is_surface(self) -> Bool[ndarray, " v"]:
        shown, through = self._counts
        is_repeated = (shown >= _MIN_IMAGES) & (shown >= _MIN_RATIO * (shown + through))
        found: Bool[ndarray, " v"] = is_repeated | ((shown > 0) & (through == 0))
        return found

    def _count(self, shown: Int64[ndarray, " s"], through: Int64[ndarray, " t"]) -> None:
        """Add one image to the counts of these voxels, of which none is in both."""
        new = np.setdiff1d(np.concatenate([shown, through]), self._keys, assume_unique=True)
        new = new[: self._most_voxels - len(self._keys)]
        keys = np.concatenate([self._keys, new])
        order = np.argsort(keys, kind="stable")
        self._keys, self._counts = keys[order], np.pad(self._counts, ((0, 0), (0, len(new))))[:, order]
        for counts, counted in zip(self._counts, (shown, through), strict=True):
            counts[np.searchsorted(self._keys, np.intersect1d(counted, self._keys, assume_unique=True))] += 1


def count_votes(views: Iterable[DepthView], voxel_m: float) -> SurfaceVotes:
    """Return the counts of all views. Raises InvalidInputError if they see more than 2^25 voxels."""
    votes = SurfaceVotes(voxel_m)
    for view in views:
        votes.add(view)
    if votes.is_full:
        raise InvalidInputError(
            f"--voxel {voxel_m:g}: expected keyframes that see fewer than {_MAX_VOXELS} voxels, got more; "
            "use larger voxels"
        )
    return votes


def rendered_depths(views: Iterable[KeyframeView], render: Render) -> Iterator[DepthView]:
    """Yield the map's depth from each view, at a width of at most 160 px; 0 without an opaque surface."""
    for view in views:
        camera = view.camera.narrower(REDUCED_WIDTH_PX)
        yield DepthView.of(render(camera, view.T_world_camera).expected_depth_m(), camera, view.T_world_camera)


def points_before_surface(
    camera: Camera, depth_m: Float32[ndarray, "h w"], T_world_camera: Float64[ndarray, "4 4"], voxel_m: float
) -> Iterator[Float64[ndarray, "c 3"]]:
    """Yield the points of all rays at one distance, in steps of half a voxel, up to the measured surface."""
    rows, columns = np.nonzero(depth_m > 0)
    x, y = camera.slopes(columns + 0.5, rows + 0.5)
    rays = np.stack([x, y, np.ones(len(x))], axis=1)
    lengths = np.linalg.norm(rays, axis=1)
    ends_m = depth_m[rows, columns].astype(np.float64) * lengths - _MARGIN_VOXELS * voxel_m
    rays = rays / lengths[:, None] @ T_world_camera[:3, :3].T
    for distance_m in np.arange(0.0, ends_m.max(initial=0.0), voxel_m / 2):
        yield T_world_camera[:3, 3] + distance_m * rays[ends_m > distance_m]
