"""Observe free space: the voxels that a frame's measured depth shows to be empty."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.camera import project
from gausslite.domain.frame import Frame
from gausslite.domain.free_space import BLOCK_SIDE, BLOCK_VOXELS, MAX_VIEWS, FreeSpace, split_indices
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import VoxelGrid

_MAX_RANGE_M, _NEAR_M = 4.0, 0.2
_MAX_VOXELS = 1_000_000
_SLACK_M, _SLACK_SHARE = 0.05, 0.02
_CELLS = np.stack(np.unravel_index(np.arange(BLOCK_VOXELS), (BLOCK_SIDE,) * 3), axis=1)
"""(i, j, k) of a block's voxels, relative to the block."""
_MIN_DEPTH_SHARE = 0.8
_RADII_PX = np.array([1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 64], np.int64)
"""Sizes of the squares in the image that hold a voxel; nearer voxels, which are larger, are not evaluated."""


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

        A voxel is free if all depths of the pixels that it may cover are behind its farthest point, and at least 80 %
        of these pixels have one. Voxels beyond 4 m are not evaluated.
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
        blocks = _blocks_in_view(frame, size_m)
        T_camera_world = inverse(frame.T_world_camera)
        corners = transform_points(T_camera_world, blocks * (size_m * BLOCK_SIDE)).astype(np.float32)
        steps = ((_CELLS + 0.5) * size_m @ T_camera_world[:3, :3].T).astype(np.float32)
        z_m = corners[:, None, 2] + steps[:, 2]
        rows, cells = np.nonzero((z_m > _NEAR_M + half_m) & (z_m < min(_MAX_RANGE_M, float(frame.depth_m.max()))))
        points = corners[rows] + steps[cells]
        pixels = np.floor(project(points, camera)).astype(np.int64)
        radius_px = np.ceil(camera.length_px(half_m, points[:, 2])).astype(np.int64)
        far_m = (points[:, 2] + half_m) * (1.0 + _SLACK_SHARE) + _SLACK_M
        size_px = (camera.width_px, camera.height_px)
        inside = ((pixels >= radius_px[:, None]) & (pixels < size_px - radius_px[:, None])).all(axis=1)
        chosen = np.flatnonzero(inside & (radius_px <= _RADII_PX[-1]))
        levels = np.searchsorted(_RADII_PX, radius_px[chosen])
        is_free = np.zeros(len(chosen), np.bool_)
        for level in np.unique(levels):
            of_level = np.flatnonzero(levels == level)
            x, y = pixels[chosen[of_level]].T
            is_free[of_level] = _nearest_depth(frame.depth_m, int(_RADII_PX[level]))[y, x] > far_m[chosen[of_level]]
        free = chosen[is_free]
        indices: Int64[ndarray, "n 3"] = blocks[rows[free]] * BLOCK_SIDE + _CELLS[cells[free]]
        return indices


def _nearest_depth(depth_m: Float32[ndarray, "h w"], radius_px: int) -> Float32[ndarray, "h w"]:
    """Return the smallest depth in the square around each pixel; 0 if too many pixels of it have none."""
    side = (2 * radius_px + 1, 2 * radius_px + 1)
    has_depth = depth_m > 0
    nearest_m = cv2.erode(np.where(has_depth, depth_m, np.float32(np.inf)), np.ones(side, np.uint8))
    share = cv2.blur(has_depth.astype(np.float32), side)
    result: Float32[ndarray, "h w"] = np.where(share >= _MIN_DEPTH_SHARE, nearest_m, np.float32(0.0))
    return result


def _blocks_in_view(frame: Frame, size_m: float) -> Int64[ndarray, "b 3"]:
    """Return the blocks that touch the view up to its farthest depth; the nearest ones if they have too many voxels."""
    camera, block_m = frame.camera, size_m * BLOCK_SIDE
    rays = camera.corner_rays()
    reach_m = min(_MAX_RANGE_M, float(frame.depth_m.max()))
    hull = transform_points(frame.T_world_camera, np.vstack([rays * reach_m, rays * _NEAR_M]))
    low, high = np.floor(hull.min(axis=0) / block_m), np.ceil(hull.max(axis=0) / block_m)
    axes = [np.arange(a, b, dtype=np.int64) for a, b in zip(low, high, strict=True)]
    blocks = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    centres_m = transform_points(inverse(frame.T_world_camera), (blocks + 0.5) * block_m)
    # the sides of the view: planes through the camera's centre and two rays, with normals that point inwards
    normals = np.cross(rays, np.roll(rays, -1, axis=0))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radius_m = 0.5 * np.sqrt(3.0) * block_m
    touches = (centres_m @ normals.T > -radius_m).all(axis=1) & (centres_m[:, 2] < reach_m + radius_m)
    blocks, z_m = blocks[touches], centres_m[touches, 2]
    nearest: Int64[ndarray, "b 3"] = blocks[np.argsort(z_m)[: _MAX_VOXELS // BLOCK_VOXELS]]
    return nearest
