"""Write and read earlier states of a run's map, coarse: map_history.safetensors in the results folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gausslite.codec.state_file import read_state, write_state
from gausslite.codec.subset_codec import CodecLimits, decode_subset, encode_subset
from gausslite.domain.errors import GaussLiteError, MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.important_gaussians import choose_gaussians
from gausslite.domain.state import get_array
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.domain.voxels import VoxelGrid

MAX_GAUSSIANS = 20_000
"""Gaussians of one state: the most important ones of the map."""
_FILE = "map_history.safetensors"
_WRITER = "history"
_GRID = VoxelGrid()
_LIMITS = CodecLimits(max_bytes=64 * MAX_GAUSSIANS, max_voxels=MAX_GAUSSIANS, max_gaussians=MAX_GAUSSIANS)


@dataclass(frozen=True, slots=True)
class MapSnapshot:
    """A map at one time, as a message of the subset codec: about 11 bytes for each of its most important Gaussians.

    time_ns: capture time of the newest frame. total: number of Gaussians of the whole map.
    """

    time_ns: int
    total: int
    message: bytes

    @classmethod
    def of(cls, time_ns: int, gaussians: Gaussians) -> MapSnapshot:
        """Encode the most important Gaussians. Raises InvalidInputError for a map that the codec cannot hold."""
        chosen = gaussians.take(choose_gaussians(gaussians, MAX_GAUSSIANS))
        subset = RoiSubset(_WRITER, _WRITER, 0, 0, group_by_voxel(chosen, _GRID))
        return cls(time_ns, len(gaussians), encode_subset(subset, _GRID))

    def gaussians(self) -> Gaussians:
        """Decode the Gaussians. Raises CodecError."""
        return decode_subset(self.message, _LIMITS)[0].batch.gaussians


def write_map_history(folder: Path, snapshots: Sequence[MapSnapshot]) -> None:
    """Write the snapshots, oldest first; a file of an earlier run is replaced. Raises StorageError."""
    messages = b"".join(each.message for each in snapshots)
    write_state(
        folder / _FILE,
        {
            "times_ns": np.array([each.time_ns for each in snapshots], np.int64),
            "totals": np.array([each.total for each in snapshots], np.int64),
            "sizes_bytes": np.array([len(each.message) for each in snapshots], np.int64),
            "messages": np.frombuffer(messages, np.uint8),
        },
    )


def read_map_history(folder: Path) -> tuple[MapSnapshot, ...]:
    """Return the snapshots, oldest first; none if the folder has no such file. Raises MapFileError."""
    path = folder / _FILE
    if not path.exists():
        return ()
    try:
        state = read_state(path)
        times_ns = get_array(state, "times_ns", (None,), np.int64)
        totals, sizes_bytes = (get_array(state, name, (len(times_ns),), np.int64) for name in ("totals", "sizes_bytes"))
        messages = get_array(state, "messages", (None,), np.uint8).tobytes()
    except GaussLiteError as error:
        raise MapFileError(f"{path}: expected the history of a map: {error}") from error
    if (sizes_bytes < 0).any() or int(sizes_bytes.sum()) != len(messages) or (np.diff(times_ns) <= 0).any():
        raise MapFileError(f"{path}: expected snapshots in the order of time with their sizes, got others")
    ends = np.cumsum(sizes_bytes)
    return tuple(
        MapSnapshot(time_ns, total, messages[end - size : end])
        for time_ns, total, size, end in zip(
            times_ns.tolist(), totals.tolist(), sizes_bytes.tolist(), ends.tolist(), strict=True
        )
    )
