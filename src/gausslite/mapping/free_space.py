"""Observe free space: the voxels that a frame's measured depth shows to be empty."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.frame import Frame
from gausslite.domain.free_space import BLOCK_VOXELS, MAX_VIEWS, FreeSpace, split_indices
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import VoxelGrid

_MAX_RANGE_M, _NEAR_M = 4.0, 0.2
_MAX_VOXELS = 400_000
_SLACK_M, _SLACK_SHARE = 0.05, 0.02
_FOOTPRINT = np.array([(x, y) for x in (0, -1, 1) for y in (0, -1, 1)], np.float64)
"""Pixels of a voxel's outline in units of its radius, the centre first."""


class FreeSpaceMap:
    """Counts the views that observed each voxel as free. Not thread-safe."""

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._free = FreeSpace.empty()
        self._changed: set[int] = set()

    @property
    def free_space(self) -> FreeSpace:
        """All blocks."""
        return self._free

    def observe(self, frame: Frame) -> None:
        """Count one view for the voxels that lie completely in front of the measured surface.

        A voxel is free if nine pixels of its outline have a depth, each behind the voxel's farthest point.
        Voxels beyond 4 m are not evaluated.
        """
        indices = self._free_indices(frame)
        if len(indices) == 0:
            return
        blocks, cells = split_indices(indices, self._grid)
        keys, where = np.unique(blocks, return_inverse=True)
        place = np.minimum(np.searchsorted(self._free.keys, keys), max(len(self._free.keys) - 1, 0))
        counts = np.zeros((len(keys), BLOCK_VOXELS), np.uint8)
        if len(self._free.keys):
            known = self._free.keys[place] == keys
            counts[known] = self._free.counts[place[known]]
        # each voxel occurs once in a frame
        counts[where.reshape(-1), cells] = np.minimum(counts[where.reshape(-1), cells] + 1, MAX_VIEWS)
        self._free = self._free.replace_blocks(FreeSpace(keys, counts))
        self._changed.update(keys.tolist())

    def collect_changes(self) -> FreeSpace:
        """Return the blocks that changed since the last call."""
        chosen = np.isin(self._free.keys, np.array(sorted(self._changed), np.int64))
        self._changed.clear()
        return FreeSpace(self._free.keys[chosen], self._free.counts[chosen])

    def _free_indices(self, frame: Frame) -> Int64[ndarray, "n 3"]:
        """Return the (i, j, k) of the voxels that this frame shows to be free."""
        size_m, camera = self._grid.size_m, frame.camera
        half_m = 0.5 * np.sqrt(3.0) * size_m
        indices = _indices_in_view(frame, size_m)
        points = transform_points(inverse(frame.T_world_camera), (indices + 0.5) * size_m)
        z_m = points[:, 2]
        chosen = np.flatnonzero((z_m > _NEAR_M + half_m) & (z_m < min(_MAX_RANGE_M, float(frame.depth_m.max()))))
        centres_px = project(points[chosen].astype(np.float32), camera).astype(np.float64)
        z_m = z_m[chosen]
        radius_px = max(camera.fx_px, camera.fy_px) * half_m / z_m
        far_m = (z_m + half_m) * (1.0 + _SLACK_SHARE) + _SLACK_M
        # the centre first: few voxels remain for the other pixels
        for offset in _FOOTPRINT:
            pixels = np.floor(centres_px + offset * radius_px[:, None]).astype(np.int64)
            inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width_px, camera.height_px)).all(axis=1)
            columns, rows = np.where(inside[:, None], pixels, 0).T
            free = inside & (frame.depth_m[rows, columns] > far_m)
            chosen, centres_px, radius_px, far_m = chosen[free], centres_px[free], radius_px[free], far_m[free]
        return indices[chosen]


def _indices_in_view(frame: Frame, size_m: float) -> Int64[ndarray, "n 3"]:
    """Return the (i, j, k) of the voxels in the box around the view up to its farthest depth; none if too many."""
    camera = frame.camera
    corners_px = np.array([(0, 0), (camera.width_px, 0), (0, camera.height_px), (camera.width_px, camera.height_px)])
    rays = np.column_stack([(corners_px - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px), np.ones(4)])
    reach_m = min(_MAX_RANGE_M, float(frame.depth_m.max()))
    hull = transform_points(frame.T_world_camera, np.vstack([rays * reach_m, rays * _NEAR_M]))
    low, high = np.floor(hull.min(axis=0) / size_m), np.ceil(hull.max(axis=0) / size_m)
    axes = [np.arange(a, b, dtype=np.int64) for a, b in zip(low, high, strict=True)]
    if np.prod([len(axis) for axis in axes]) > _MAX_VOXELS:
        return np.zeros((0, 3), np.int64)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
