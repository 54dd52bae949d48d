"""Find occupied and free space and write it for planners: OctoMap trees, nav2 grids, distances to obstacles.

Of a grid, surfaces and free space are what depth images show (`surface_votes`); all other space is unknown. Without
keyframes, surfaces are the voxels of opaque Gaussians, and a cell is free only where the map has a floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import Bool, Float32, Float64, Int8, Int64
from numpy import ndarray

from gausslite.codec.state_file import write_atomic, write_atomic_with
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_points
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
_SEEN_M, _SEEN_SHARE, _LOWEST_M = 0.9, 0.3, 0.3
"""A cell without an obstacle is free if images show its floor or see through one of its voxels in the lowest 0.3 m of
the heights, and see through 30 % of the lowest 0.9 m: over the unseen half of an ottoman they see higher ones only."""
_SPECK_CELLS = 4
_OUTLIER_FACTOR, _LEAST_REACH_M = 20.0, 20.0
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


def near_middle(gaussians: Gaussians, chosen: Gaussians) -> tuple[Bool[ndarray, " n"], float]:
    """Return what lies and reaches at most 20 times as far from the middle as 99 % of the chosen, and how far that is.

    The cells of a grid cover all that is between; a single Gaussian of a wrong measurement would decide their number.
    """
    middle_m = np.median(chosen.means_m, axis=0)
    reaches_m, chosen_m = (
        np.abs(part.means_m - middle_m).max(axis=1) + part.scales_m.max(axis=1) for part in (gaussians, chosen)
    )
    limit_m = max(_LEAST_REACH_M, _OUTLIER_FACTOR * float(np.percentile(chosen_m, 99)))
    return reaches_m <= limit_m, limit_m


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


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """Cells in x and y of the upright map, by row (y) and column (x): UNKNOWN, FREE or OCCUPIED, and where they lie.

    origin_m: lower corner of the first cell. floor_m: height of the floor. T_upright_map: turns the map upright.
    """

    cells: Int8[ndarray, "h w"]
    origin_m: Float64[ndarray, "2"]
    cell_m: float
    floor_m: float
    T_upright_map: Float64[ndarray, "4 4"]

    @property
    def T_map_grid(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - frames of transforms are named so
        """The pose of the grid's frame, whose z axis is up and 0 at the floor."""
        T_upright_grid = np.eye(4)
        T_upright_grid[2, 3] = self.floor_m
        return inverse(self.T_upright_map) @ T_upright_grid

    def cell_at(self, point_m: Float64[ndarray, "3"]) -> tuple[int, int] | None:
        """Return the row and column of a point of the map; None beyond the grid."""
        upright_m = transform_points(self.T_upright_map, point_m)[:2]
        column, row = np.floor((upright_m - self.origin_m) / self.cell_m).astype(int).tolist()
        height, width = self.cells.shape
        return (row, column) if 0 <= row < height and 0 <= column < width else None

    @property
    def distance_m(self) -> Float32[ndarray, "h w"]:
        """The distance from each cell's middle to that of the nearest OCCUPIED cell, infinite without one.

        Inside of obstacles it is 0 or negative: up to the nearest cell at their border. UNKNOWN cells are no obstacles.
        """
        occupied = (self.cells == OCCUPIED).astype(np.uint8)
        if not occupied.any():
            return np.full(self.cells.shape, np.inf, np.float32)
        outside, inside = (
            cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for image in (1 - occupied, occupied)
        )
        distance_m: Float32[ndarray, "h w"] = np.where(occupied, np.minimum(1 - inside, 0), outside) * self.cell_m
        return distance_m.astype(np.float32)


def write_nav2(path: Path, grid: FloorGrid) -> None:
    """Write a nav2 map: `path` is the YAML file, its image has the suffix NAV2_IMAGE. Raises StorageError."""
    encoded, data = cv2.imencode(".pgm", _GREY_VALUES[grid.cells[::-1]])
    if not encoded:
        raise InvalidInputError(f"nav2: expected an image that OpenCV can encode, got {grid.cells.shape}")
    image_path = path.with_suffix(NAV2_IMAGE)
    write_atomic(image_path, data.tobytes())
    description = {
        "image": image_path.name,
        "mode": "trinary",
        "resolution": grid.cell_m,
        "origin": [*grid.origin_m.tolist(), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
        "T_map_grid": grid.T_map_grid.tolist(),  # map servers ignore it
    }
    write_atomic(path, yaml.safe_dump(description, sort_keys=False).encode())


def write_distances(path: Path, grid: FloorGrid) -> None:
    """Write the grid with its distances as an .npz file of NumPy. Raises StorageError."""
    arrays = {name: getattr(grid, name) for name in ("cells", "distance_m", "origin_m", "cell_m", "T_map_grid")}

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomic_with(path, write)


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
    voxels: Int64[ndarray, "v 3"],
    free: Int64[ndarray, "f 3"],
    settings: OccupancySettings,
    T_upright_map: Float64[ndarray, "4 4"] | None = None,
) -> FloorGrid:
    """Return the grid of the upright map's occupied and free voxels.

    It spans the occupied voxels. The floor is their lowest full layer. A cell is OCCUPIED by a voxel at an obstacle's
    height; else FREE with enough free voxels at these heights, or over a floor if nothing is known to be free; else
    UNKNOWN. Raises InvalidInputError, before memory is taken, for too many cells.
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
    inside = ((free >= first) & (free <= last))[:, :2].all(axis=1) & (free_above_m >= low_m)

    def seen(range_m: float) -> Int64[ndarray, "h w"]:
        column, row = (free[inside & (free_above_m < low_m + range_m)][:, :2] - first[:2]).T
        return np.bincount(row * width + column, minlength=height * width).reshape(height, width)

    seen_m = min(high_m - low_m, _SEEN_M)
    is_low_seen, is_seen = seen(_LOWEST_M) > 0, seen(seen_m) >= _SEEN_SHARE * seen_m / settings.voxel_m
    column, row = (voxels[above_m < low_m][:, :2] - first[:2]).T
    is_low_seen[row, column] = True
    cells = np.where(is_low_seen & (is_seen | (len(free) == 0)), FREE, UNKNOWN).astype(np.int8)
    obstacles = voxels[(above_m >= low_m) & (above_m <= high_m)] - (*first[:2], floor)
    cells[_without_specks(obstacles, (height, width))] = OCCUPIED
    T = np.eye(4) if T_upright_map is None else T_upright_map
    return FloorGrid(cells, first[:2] * settings.voxel_m, settings.voxel_m, (floor + 1) * settings.voxel_m, T)


def _without_specks(obstacles: Int64[ndarray, "v 3"], shape: tuple[int, int]) -> Bool[ndarray, "h w"]:
    """Return the cells with an obstacle, without small ones of one low voxel a cell: errors of the floor's depth."""
    counts, has_higher = np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
    column, row, layer = obstacles.T
    counts[row, column] = 1
    higher = layer > layer.min(initial=np.iinfo(np.int64).max)
    has_higher[row[higher], column[higher]] = True
    _, labels, figures, _ = cv2.connectedComponentsWithStats(counts, connectivity=8)
    is_obstacle = figures[:, cv2.CC_STAT_AREA] >= _SPECK_CELLS
    is_obstacle[labels[has_higher]] = True
    is_obstacle[0] = False
    return np.asarray(is_obstacle[labels])


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
