"""Ground-truth regions in a file of the sequence's folder: for each object, the voxels of its surface."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.relevance import BallRegion, Region, VoxelRegion

REGIONS_FILE = "roi_voxels.npz"
"""Name of the file in the folder of the sequence."""
_SIZE_KEY = "voxel_size_m"
_MAX_SIDE_VOXELS = 512
_MAX_INDEX = 100_000
_MAX_UNPACKED_BYTES = 1 << 28
_SMALL_OBJECT_M = 0.25
_SMALL_OBJECT_RADIUS_M = 0.10


def load_voxel_regions(path: Path) -> dict[str, VoxelRegion]:
    """Return regions by object name from an .npz file.

    The file holds voxel_size_m and, for each object, an integer array [n, 3] of floor(p_world / voxel_size_m). Raises
    DatasetError with the names of the file and of the invalid array.
    """
    try:
        _require_small(path)
        # no pickle: the file may come from an untrusted source
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name]) for name in stored.files}
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a file of regions (.npz), got none") from None
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
            raise DatasetError(f"{path}: {name}: expected voxels within ±{_MAX_INDEX}, got a larger index")
        side = int((voxels.max(axis=0).astype(np.int64) - voxels.min(axis=0).astype(np.int64)).max()) + 1
        if side > _MAX_SIDE_VOXELS:
            raise DatasetError(f"{path}: {name}: expected at most {_MAX_SIDE_VOXELS} voxels along an axis, got {side}")
        regions[name] = VoxelRegion(voxels.astype(np.int64), float(size.reshape(())))
    if not regions:
        raise DatasetError(f"{path}: expected at least one object, got none")
    return regions


def balls_for_small_objects(regions: Mapping[str, VoxelRegion]) -> dict[str, Region]:
    """Replace small objects by a ball of radius 0.10 m around their centroid.

    Voxels of 2 cm are coarse for a mug: they miss its far side and include depth noise along the view. An object is
    small if 80 % of its voxels lie within 0.25 m along each axis; the rest may be such noise.
    """
    result: dict[str, Region] = {}
    for name, region in regions.items():
        extent_m = np.diff(np.percentile(region.voxels, [10, 90], axis=0), axis=0) * region.size_m
        if float(extent_m.max()) < _SMALL_OBJECT_M:
            x, y, z = region.centroid_m
            result[name] = BallRegion((float(x), float(y), float(z)), _SMALL_OBJECT_RADIUS_M)
        else:
            result[name] = region
    return result


def choose_regions(regions: Mapping[str, Region], names: Sequence[str]) -> list[Region]:
    """Return the regions with these names, or all if names is empty. Raises InvalidInputError."""
    if not regions:
        raise InvalidInputError(
            "objects: expected regions to choose from, with --roi FILE.npz; the sequence has none; "
            "--set target-at=X,Y,Z,RADIUS states a place instead"
        )
    unknown = [name for name in names if name not in regions]
    if unknown:
        known = ", ".join(sorted(regions))
        raise InvalidInputError(f"objects: expected names among {known}; got {', '.join(unknown)}")
    return [regions[name] for name in names] if names else list(regions.values())


def _require_small(path: Path) -> None:
    """Raise DatasetError if the file unpacks to more than 256 MiB."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    if unpacked > _MAX_UNPACKED_BYTES:
        raise DatasetError(f"{path}: expected at most {_MAX_UNPACKED_BYTES} bytes of regions, got {unpacked}")
