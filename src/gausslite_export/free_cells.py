"""Find the voxels that cameras see through: free space between a camera and the surface."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite_export.mesh import Render

_WIDTH_PX = 160
_MAX_VOXELS = 1 << 28
_MARGIN_VOXELS = 1.0
"""Rays end this far before the surface, whose depth is an average over its thickness."""


def free_voxels(
    views: Iterable[KeyframeView],
    render: Render,
    chosen: Int64[ndarray, "c 3"],
    occupied: Int64[ndarray, "v 3"],
    voxel_m: float,
) -> Int64[ndarray, "f 3"]:
    """Return the voxels that a ray of a view crosses before its surface, sorted, without the occupied ones.

    They lie in the box around the chosen voxels. A ray without an opaque surface frees nothing. The map is rendered
    at a width of at most 160 px. Raises InvalidInputError, before memory is taken, for a box of over 2^28 voxels.
    """
    first = chosen.min(axis=0)
    shape = chosen.max(axis=0) - first + 1
    count = math.prod(shape.tolist())
    if count > _MAX_VOXELS:
        raise InvalidInputError(
            f"--voxel {voxel_m:g}: expected a map of at most {_MAX_VOXELS} voxels for free space, got {count}; "
            "use larger voxels"
        )
    free = np.zeros(tuple(shape), np.bool_)
    for view in views:
        _carve(free, first, view, render, voxel_m)
    taken = occupied - first
    free[tuple(taken[((taken >= 0) & (taken < free.shape)).all(axis=1)].T)] = False
    found: Int64[ndarray, "f 3"] = np.argwhere(free) + first
    return found


def _carve(
    free: Bool[ndarray, "x y z"], first: Int64[ndarray, "3"], view: KeyframeView, render: Render, voxel_m: float
) -> None:
    """Mark the voxels before the surface of one view."""
    camera = view.camera.narrower(_WIDTH_PX)
    depth_m = render(camera, view.T_world_camera).expected_depth_m()
    for points_m in points_before_surface(camera, depth_m, view.T_world_camera, voxel_m):
        cells = np.floor(points_m / voxel_m).astype(np.int64) - first
        cells = cells[((cells >= 0) & (cells < free.shape)).all(axis=1)]
        free[tuple(cells.T)] = True


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
