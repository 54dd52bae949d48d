"""Ground-truth regions stored beside a sequence: per object, the voxels of its surface."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gausslite.domain.region import BallRegion, Region, VoxelRegion
from gausslite.errors import DatasetError, InvalidInputError

REGIONS_FILE = "roi_voxels.npz"
"""Where a sequence's own regions are, in its folder."""
_SIZE_KEY = "voxel_size_m"
_MAX_SIDE_VOXELS = 512
_MAX_INDEX = 100_000
_MAX_UNPACKED_BYTES = 1 << 28
_SMALL_OBJECT_M = 0.25
_SMALL_OBJECT_RADIUS_M = 0.10


def load_voxel_regions(path: Path) -> dict[str, VoxelRegion]:
    """Regions by object name from an .npz: integer arrays [n, 3] of floor(p_world / voxel_size_m), and voxel_size_m.

    Raises DatasetError naming the file, and the array where one is wrong.
    """
    try:
        _require_small(path)
        # never unpickle: the file may come from anywhere
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name]) for name in stored.files}
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a file of regions (.npz), there is none") from None
    except (OSError, ValueError, EOFError, AttributeError, TypeError, MemoryError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: expected a readable .npz of plain arrays, got {type(error).__name__}") from None
    size = arrays.pop(_SIZE_KEY, None)
    if size is None or size.size != 1 or size.dtype.kind not in "fiu" or not 1e-3 <= float(size.reshape(())) <= 10:
        raise DatasetError(f"{path}: expected {_SIZE_KEY}, one number from 0.001 to 10, got {size}")
    regions = {}
    for name, voxels in arrays.items():
        if voxels.ndim != 2 or voxels.shape[1] != 3 or len(voxels) == 0 or voxels.dtype.kind not in "iu":
            raise DatasetError(f"{path}: {name}: expected integers [n, 3], got {voxels.dtype} {voxels.shape}")
        if float(voxels.max()) > _MAX_INDEX or float(voxels.min()) < -_MAX_INDEX:
            raise DatasetError(f"{path}: {name}: expected voxels within ±{_MAX_INDEX}, got one beyond")
        side = int((voxels.max(axis=0).astype(np.int64) - voxels.min(axis=0).astype(np.int64)).max()) + 1
        if side > _MAX_SIDE_VOXELS:
            raise DatasetError(f"{path}: {name}: expected at most {_MAX_SIDE_VOXELS} voxels along an axis, got {side}")
        regions[name] = VoxelRegion(voxels.astype(np.int64), float(size.reshape(())))
    if not regions:
        raise DatasetError(f"{path}: expected at least one object, got none")
    return regions


def regions_beside(folder: Path) -> dict[str, Region]:
    """Those of a sequence's own file, small objects as balls; none where there is no file. Raises DatasetError."""
    path = folder / REGIONS_FILE
    return balls_for_small_objects(load_voxel_regions(path)) if path.is_file() else {}


def balls_for_small_objects(regions: Mapping[str, VoxelRegion]) -> dict[str, Region]:
    """Replace small objects by a ball of 0.10 m round their centroid.

    Voxels of 2 cm are coarse for a mug: they miss its far wall and pick up depth noise along the view. Small means
    that 80 % of the voxels lie within 0.25 m along each axis, which leaves room for that noise.
    """
    chosen: dict[str, Region] = {}
    for name, region in regions.items():
        span = np.diff(np.percentile(region.voxels, [10, 90], axis=0), axis=0) * region.size_m
        if float(span.max()) < _SMALL_OBJECT_M:
            x, y, z = region.centroid_m
            chosen[name] = BallRegion((float(x), float(y), float(z)), _SMALL_OBJECT_RADIUS_M)
        else:
            chosen[name] = region
    return chosen


def choose_regions(regions: Mapping[str, Region], names: Sequence[str]) -> list[Region]:
    """The regions with these names; all of them when no name is given. Raises InvalidInputError."""
    if not regions:
        raise InvalidInputError("objects: expected regions to choose from, with --roi FILE.npz; the sequence has none")
    unknown = [name for name in names if name not in regions]
    if unknown:
        known = ", ".join(sorted(regions))
        raise InvalidInputError(f"objects: expected names among {known}; got {', '.join(unknown)}")
    return [regions[name] for name in names] if names else list(regions.values())


def _require_small(path: Path) -> None:
    """A few bytes of zip can unpack to more than there is memory for."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > _MAX_UNPACKED_BYTES:
        raise DatasetError(f"{path}: expected at most {_MAX_UNPACKED_BYTES} bytes of regions, got {unpacked}")
