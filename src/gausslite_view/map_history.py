"""Keep earlier states of a run's map, in map_history.safetensors, for the slider over its time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gausslite.codec.state_file import read_state, write_state
from gausslite.codec.subset_codec import CodecLimits, decode_subset, encode_subset
from gausslite.domain.errors import GaussLiteError, InvalidInputError, MapFileError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.state import get_array
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.task_mapper import FrameOutcome
from gausslite_view.even_history import EvenHistory
from gausslite_view.important_gaussians import choose_from_parts

_MAX_SNAPSHOTS, _LEAST_GAP_NS = 48, 250_000_000
MAX_GAUSSIANS = 20_000
"""Gaussians of one state: the most important ones of the map."""
_MAP_HISTORY_FILE = "map_history.safetensors"
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
    def of(cls, time_ns: int, parts: Iterable[Gaussians]) -> MapSnapshot:
        """Encode the most important Gaussians. Raises InvalidInputError for a map that the codec cannot hold."""
        chosen, total = choose_from_parts(parts, MAX_GAUSSIANS)
        subset = RoiSubset(_WRITER, _WRITER, 0, 0, group_by_voxel(chosen, _GRID))
        return cls(time_ns, total, encode_subset(subset, _GRID))

    def gaussians(self) -> Gaussians:
        """Decode the Gaussians. Raises CodecError."""
        return decode_subset(self.message, _LIMITS)[0].batch.gaussians


def write_map_history(folder: Path, snapshots: Sequence[MapSnapshot]) -> None:
    """Write the snapshots, oldest first; a file of an earlier run is replaced. Raises StorageError."""
    messages = b"".join(snapshot.message for snapshot in snapshots)
    write_state(
        folder / _MAP_HISTORY_FILE,
        {
            "times_ns": np.array([snapshot.time_ns for snapshot in snapshots], np.int64),
            "totals": np.array([snapshot.total for snapshot in snapshots], np.int64),
            "sizes_bytes": np.array([len(snapshot.message) for snapshot in snapshots], np.int64),
            "messages": np.frombuffer(messages, np.uint8),
        },
    )


def read_map_history(folder: Path) -> tuple[MapSnapshot, ...]:
    """Return the snapshots, oldest first; none if the folder has no such file. Raises MapFileError."""
    path = folder / _MAP_HISTORY_FILE
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


@dataclass(slots=True)
class MapRecorder:
    """Keeps at most 48 snapshots (25 ms and 230 kB each), four a second of the recording at most."""

    _snapshots: EvenHistory[MapSnapshot] = field(default_factory=lambda: EvenHistory(_MAX_SNAPSHOTS, _LEAST_GAP_NS))

    def add(self, _outcome: FrameOutcome, poses: PoseTable, parts: Callable[[], Iterable[Gaussians]]) -> None:
        """Take a snapshot of the map after a frame, if one is due."""
        latest = poses.latest()
        if latest is None or not self._snapshots.is_due(latest.capture_time_ns):
            return
        # a map with a value that the codec refuses is still mapped further
        with suppress(InvalidInputError):
            snapshot = MapSnapshot.of(latest.capture_time_ns, parts())
            self._snapshots.add(snapshot.time_ns, snapshot)

    def write(self, folder: Path, _keyframes: Sequence[Keyframe]) -> None:
        """Write map_history.safetensors, with the snapshots since the start of this run. Raises StorageError."""
        write_map_history(folder, self._snapshots.states)
