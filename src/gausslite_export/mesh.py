"""Reconstruct a triangle mesh: fuse rendered depth images to a truncated signed distance function (TSDF)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.codec.state_file import write_atomic
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_points
from gausslite.process import import_extra
from gausslite.render.rasterizer import Rendering

_TRUNCATION_VOXELS = 4.0
_MIN_ALPHA = 0.5
_MAX_VOXELS = 1 << 23
_BOUNDS_PERCENTILES = (0.5, 99.5)
_VERTEX = np.dtype([("position_m", "<f4", 3), ("rgb", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


Render = Callable[[Camera, Float64[ndarray, "4 4"]], Rendering]
"""Renders the whole map from a camera pose (camera, T_world_camera)."""


@dataclass(eq=False)
class TsdfVolume:
    """A grid of signed distances to the surface, in units of the truncation distance, with weights and colours.

    Follows Curless and Levoy (1996): each view adds its distance along the viewing ray, with weight 1.
    """

    origin_m: Float64[ndarray, "3"]
    voxel_m: float
    shape: tuple[int, int, int]
    distances: Float32[ndarray, "n"] = field(init=False)
    weights: Float32[ndarray, "n"] = field(init=False)
    colours: Float32[ndarray, "n 3"] = field(init=False)

    def __post_init__(self) -> None:
        count = math.prod(self.shape)
        self.distances = np.ones(count, np.float32)
        self.weights = np.zeros(count, np.float32)
        self.colours = np.zeros((count, 3), np.float32)
        indices = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        self._centres_m = (self.origin_m + (indices + 0.5) * self.voxel_m).astype(np.float32)

    def integrate(self, view: KeyframeView, rendering: Rendering) -> None:
        """Add one rendered view."""
        rows, pixels, depth_m = self._visible(view)
        surface_m = rendering.expected_depth_m()[pixels]
        signed = (surface_m - depth_m) / (_TRUNCATION_VOXELS * self.voxel_m)
        kept = (rendering.alpha[pixels] > _MIN_ALPHA) & (surface_m > 0) & (signed > -1)
        rows, signed = rows[kept], np.minimum(signed[kept], 1)
        new_weights = self.weights[rows] + 1
        self.distances[rows] += (signed - self.distances[rows]) / new_weights
        self.colours[rows] += (rendering.rgb[tuple(axis[kept] for axis in pixels)] - self.colours[rows]) / new_weights[
            :, None
        ]
        self.weights[rows] = new_weights

    def _visible(self, view: KeyframeView) -> tuple[ndarray, tuple[ndarray, ndarray], ndarray]:
        """Return the voxels inside the image, their pixels (row, column) and their depths in metres."""
        camera = view.camera
        points = transform_points(inverse(view.T_world_camera), self._centres_m)
        depth_m = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            columns, image_rows = camera.pixels(points[:, 0] / depth_m, points[:, 1] / depth_m)
        inside = (depth_m > self.voxel_m) & (columns >= 0) & (columns < camera.width_px)
        inside &= (image_rows >= 0) & (image_rows < camera.height_px)
        rows = np.flatnonzero(inside)
        return rows, (image_rows[rows].astype(np.intp), columns[rows].astype(np.intp)), depth_m[rows]

    def inner(self) -> Bool[ndarray, "x y z"]:
        """Return the mask of voxels that views have seen together with all 26 neighbours.

        Elsewhere the distance is unknown, and the end of the known space would look like a surface.
        """
        mask = (self.weights > 0).reshape(self.shape)
        for axis in range(3):
            seen = np.moveaxis(mask, axis, 0)
            kept = np.zeros_like(seen)
            kept[1:-1] = seen[:-2] & seen[1:-1] & seen[2:]
            mask = np.moveaxis(kept, 0, axis)
        return mask


def write_mesh(
    path: Path,
    gaussians: Gaussians,
    views: Sequence[KeyframeView],
    render: Render,
    voxel_m: float,
    progress: Callable[[Iterable[KeyframeView]], Iterable[KeyframeView]] = iter,
) -> None:
    """Write a coloured triangle mesh of the space around the Gaussians as a binary PLY file.

    views: where to render the map from; the mission's keyframes show each surface from its free side. render: renders
    the whole map, because other surfaces hide parts of the region. Raises InvalidInputError without views, without a
    surface or without the scikit-image package, StorageError.
    """
    measure = import_extra("skimage.measure", "export", "meshes")
    if not views:
        raise InvalidInputError("mesh: expected a results folder with keyframes.json, got none")
    volume = _volume_around(gaussians, voxel_m)
    for view in progress(views):
        volume.integrate(view, render(view.camera, view.T_world_camera))
    distances, inner = volume.distances.reshape(volume.shape), volume.inner()
    if not (inner.any() and distances[inner].min() < 0 < distances[inner].max()):
        raise InvalidInputError("mesh: expected a surface that the keyframes show, found none in the chosen Gaussians")
    vertices, faces, _, _ = measure.marching_cubes(distances, 0.0, mask=inner)
    colours = volume.colours.reshape(*volume.shape, 3)[tuple(np.round(vertices).astype(np.intp).T)]
    positions_m = volume.origin_m + (vertices + 0.5) * voxel_m
    write_atomic(path, _ply_mesh(positions_m.astype(np.float32), colours, faces.astype(np.int32)))


def fitting_voxel_m(gaussians: Gaussians, least_m: float) -> float:
    """Return the least voxel size, in millimetres above this one, with which the Gaussians' volume fits into memory."""
    voxel_m = least_m
    while math.prod(_bounds(gaussians, voxel_m)[1]) > _MAX_VOXELS:
        voxel_m = math.ceil(1000 * 1.02 * voxel_m) / 1000
    return voxel_m


def _bounds(gaussians: Gaussians, voxel_m: float) -> tuple[Float64[ndarray, "3"], tuple[int, int, int]]:
    """Return the origin and shape of a volume around the Gaussians without the farthest 0.5 % along each axis."""
    low, high = np.percentile(gaussians.means_m.astype(np.float64), _BOUNDS_PERCENTILES, axis=0)
    margin_m = (_TRUNCATION_VOXELS + 1) * voxel_m
    x, y, z = np.ceil((high - low + 2 * margin_m) / voxel_m).astype(int).tolist()
    return low - margin_m, (x, y, z)


def _volume_around(gaussians: Gaussians, voxel_m: float) -> TsdfVolume:
    """Return an empty volume around the Gaussians."""
    origin_m, shape = _bounds(gaussians, voxel_m)
    if (count := math.prod(shape)) > _MAX_VOXELS:
        least_m = fitting_voxel_m(gaussians, voxel_m)
        raise InvalidInputError(f"mesh: expected at most {_MAX_VOXELS} voxels, got {count}; use --voxel {least_m:g}")
    return TsdfVolume(origin_m, voxel_m, shape)


def _ply_mesh(
    positions_m: Float32[ndarray, "v 3"], colours: Float32[ndarray, "v 3"], faces: Int32[ndarray, "f 3"]
) -> bytes:
    vertices = np.zeros(len(positions_m), _VERTEX)
    vertices["position_m"], vertices["rgb"] = positions_m, np.clip(np.round(colours * 255), 0, 255)
    triangles = np.zeros(len(faces), _FACE)
    triangles["count"], triangles["vertices"] = 3, faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + triangles.tobytes()
