"""Find the voxels that the Gaussians occupy and write them for planners: OctoMap trees and nav2 grids.

A map of Gaussians holds surfaces; free space is what its keyframes see through (`free_cells`). All other space is
unknown. Without keyframes a voxel is never free, and a grid cell only where the map has a floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import Float32, Int8, Int64
from numpy import ndarray

from gausslite.codec.state_file import write_atomic, write_atomic_with
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.process import import_extra

_EXTENT_SIGMAS = 1.5
_MAX_SAMPLES_PER_AXIS = 33
_MAX_SAMPLES = 1 << 28
_MAX_GRID_CELLS = 1 << 26
_MAX_OCTOMAP_KEY = 1 << 15
"""OctoMap keys are 16-bit integers with the origin in the middle."""
NAV2_IMAGE = ".pgm"
"""Suffix of the image beside a nav2 map."""
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of a cell, as in nav_msgs/OccupancyGrid."""
_GREY_VALUES = np.zeros(256, np.uint8)
_GREY_VALUES[[UNKNOWN, FREE, OCCUPIED]] = 205, 254, 0
"""Of trinary map images, by the value of a cell."""
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
"""Map servers read (255 - grey) / 255 beyond these as occupied and free: 0.1961 for unknown must lie between."""
_FLOOR_SHARE = 0.25
"""Of the fullest layer of voxels. Ellipsoids of the floor reach below it, but few of them."""
NO_VOXELS: Int64[ndarray, "0 3"] = np.zeros((0, 3), np.int64)


@dataclass(frozen=True, slots=True)
class OccupancySettings:
    """How Gaussians become occupied space.

    voxel_m: side of a voxel or cell. min_opacity: Gaussians below it occupy nothing. height_m: the lowest and highest
    obstacle above the floor that a robot can hit (nav2).
    """

    voxel_m: float = 0.05
    min_opacity: float = 0.3
    height_m: tuple[float, float] = (0.1, 1.8)


def occupied_voxels(gaussians: Gaussians, settings: OccupancySettings) -> Int64[ndarray, "v 3"]:
    """Return the indices floor(p / voxel_m) of all voxels that an ellipsoid of 1.5 standard deviations touches.

    Each ellipsoid is sampled in steps of half a voxel, at most 33 per axis. The result is sorted and unique. Raises
    InvalidInputError, before memory is taken, if all ellipsoids together have more than 2^28 samples.
    """
    chosen = gaussians.take(gaussians.opacities >= settings.min_opacity)
    if not len(chosen):
        return np.zeros((0, 3), np.int64)
    axes = _rotation_matrices(chosen.quats_wxyz) * (_EXTENT_SIGMAS * chosen.scales_m[:, None, :])
    steps = np.ceil(2 * _EXTENT_SIGMAS * chosen.scales_m / (settings.voxel_m / 2)).astype(np.int64)
    counts = np.clip(steps + 1 - steps % 2, 1, _MAX_SAMPLES_PER_AXIS)  # odd, so that the centre is a sample
    samples = int(counts.prod(axis=1).sum())
    if samples > _MAX_SAMPLES:
        raise InvalidInputError(
            f"--voxel {settings.voxel_m:g}: expected at most {_MAX_SAMPLES} samples of the Gaussians, got {samples}; "
            "use larger voxels"
        )
    found = []
    for count in np.unique(counts, axis=0):  # all Gaussians with the same numbers of samples at once
        rows = np.flatnonzero((counts == count).all(axis=1))
        offsets = _ellipsoid_samples(count)
        for part in np.array_split(rows, max(1, len(rows) * len(offsets) // 2_000_000)):
            points = chosen.means_m[part, None, :] + np.einsum("nij,kj->nki", axes[part], offsets)
            found.append(np.unique(np.floor(points.reshape(-1, 3) / settings.voxel_m).astype(np.int64), axis=0))
    return np.unique(np.concatenate(found), axis=0)


def write_octomap(
    path: Path, gaussians: Gaussians, settings: OccupancySettings, free: Int64[ndarray, "f 3"] = NO_VOXELS
) -> None:
    """Write an OctoMap binary tree (.bt) of the occupied and the free voxels; all other space is unknown.

    Raises InvalidInputError without the pyoctomap package, without an occupied voxel or if the map reaches beyond
    OctoMap's keys; StorageError.
    """
    octomap = import_extra("pyoctomap", "export", "OctoMap files")
    voxels = require_voxels(gaussians, settings)
    reach = int(np.maximum(-voxels.min(), voxels.max() + 1))
    if reach > _MAX_OCTOMAP_KEY:
        raise InvalidInputError(
            f"octomap: expected a map within {_MAX_OCTOMAP_KEY * settings.voxel_m:g} m of the origin with --voxel "
            f"{settings.voxel_m:g}, got one up to {reach * settings.voxel_m:g} m; use larger voxels"
        )
    tree = octomap.OcTree(settings.voxel_m)
    for cells, occupied in ((free, False), (voxels, True)):
        for centre_m in (cells + 0.5) * settings.voxel_m:
            tree.updateNode(centre_m, occupied, True)
    tree.updateInnerOccupancy()

    def write(partial: Path) -> None:
        # OctoMap reports a full disk by its result only
        if not tree.writeBinary(str(partial)):
            raise StorageError(f"{path}: expected a complete file, got an error; check the disk's free space")

    write_atomic_with(path, write)


def write_nav2(
    path: Path, gaussians: Gaussians, settings: OccupancySettings, free: Int64[ndarray, "f 3"] = NO_VOXELS
) -> None:
    """Write a nav2 map: `path` is the YAML file, the image next to it has the suffix NAV2_IMAGE.

    The map's z axis must point up. Raises InvalidInputError without an occupied voxel or if the grid is too large,
    StorageError.
    """
    cells, first = planar_grid(require_voxels(gaussians, settings), free, settings)
    image, origin_m = _GREY_VALUES[cells[::-1]], first * settings.voxel_m
    encoded, data = cv2.imencode(".pgm", image)
    if not encoded:
        raise InvalidInputError(f"nav2: expected an image that OpenCV can encode, got {image.shape}")
    image_path = path.with_suffix(NAV2_IMAGE)
    write_atomic(image_path, data.tobytes())
    description = {
        "image": image_path.name,
        "mode": "trinary",
        "resolution": settings.voxel_m,
        "origin": [float(origin_m[0]), float(origin_m[1]), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    write_atomic(path, yaml.safe_dump(description, sort_keys=False).encode())


def require_voxels(gaussians: Gaussians, settings: OccupancySettings) -> Int64[ndarray, "v 3"]:
    """Return the occupied voxels, at least one. Raises InvalidInputError."""
    voxels = occupied_voxels(gaussians, settings)
    if not len(voxels):
        raise InvalidInputError(
            f"--min-opacity {settings.min_opacity:g}: expected an opacity that some Gaussian has, "
            f"got at most {gaussians.opacities.max():.2f}"
        )
    return voxels


def planar_grid(
    voxels: Int64[ndarray, "v 3"], free: Int64[ndarray, "f 3"], settings: OccupancySettings
) -> tuple[Int8[ndarray, "h w"], Int64[ndarray, "2"]]:
    """Return a grid in x and y, its first row at the lowest y, and the indices (x, y) of its first cell.

    It spans the occupied voxels. The floor is their lowest full layer. A cell is OCCUPIED by a voxel at
    an obstacle's height, else FREE over a floor or with a free voxel at an obstacle's height, else UNKNOWN. Raises
    InvalidInputError, before memory is taken, for too many cells.
    """
    first, last = voxels.min(axis=0), voxels.max(axis=0)
    width, height = (int(n) for n in (last - first + 1)[:2])
    if width * height > _MAX_GRID_CELLS:
        raise InvalidInputError(
            f"nav2: expected at most {_MAX_GRID_CELLS} cells, got {width} x {height}; use a larger --voxel"
        )
    floor = floor_layer(voxels)
    above_m, free_above_m = ((found[:, 2] - floor) * settings.voxel_m for found in (voxels, free))
    low_m, high_m = settings.height_m
    inside = ((free >= first) & (free <= last))[:, :2].all(axis=1)
    grid = np.full((height, width), UNKNOWN, np.int8)
    for value, found in (
        (FREE, free[inside & (free_above_m >= low_m) & (free_above_m <= high_m)]),
        (FREE, voxels[above_m < low_m]),
        (OCCUPIED, voxels[(above_m >= low_m) & (above_m <= high_m)]),
    ):
        x, y = (found[:, :2] - first[:2]).T
        grid[y, x] = value
    return grid, first[:2]


def floor_layer(voxels: Int64[ndarray, "v 3"]) -> int:
    """Return the height of the floor: the fullest of the layers that rise from the lowest full one."""
    lowest = voxels[:, 2].min()
    layers = np.bincount(voxels[:, 2] - lowest)
    floor = int(np.argmax(layers >= _FLOOR_SHARE * layers.max()))
    while floor + 1 < len(layers) and layers[floor + 1] > layers[floor]:
        floor += 1
    return int(lowest) + floor


def _ellipsoid_samples(count: Int64[ndarray, "3"]) -> Float32[ndarray, "k 3"]:
    """Return a regular grid of points in the unit ball with this many points per axis."""
    axes = [np.linspace(-1, 1, int(n)) if n > 1 else np.zeros(1) for n in count]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    inside: Float32[ndarray, "k 3"] = points[(points**2).sum(axis=1) <= 1 + 1e-6]
    return inside


def _rotation_matrices(quats_wxyz: Float32[ndarray, "n 4"]) -> Float32[ndarray, "n 3 3"]:
    w, x, y, z = (quats_wxyz / np.maximum(np.linalg.norm(quats_wxyz, axis=1, keepdims=True), 1e-12)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
