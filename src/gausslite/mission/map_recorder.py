"""Record how the map grows during a mission, for the scrub over time of the live view."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.codec.map_history import MapSnapshot, write_map_history
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.even_history import EvenHistory
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.pose_history import PoseHistory

_MAX_SNAPSHOTS, _LEAST_GAP_NS = 48, 250_000_000


@dataclass(slots=True)
class MapRecorder:
    """Keeps at most 48 snapshots, at most 11 MB.

    One takes about 25 ms. There are at most four a second of the recording, fewer in a longer mission.
    """

    _snapshots: EvenHistory[MapSnapshot] = field(default_factory=lambda: EvenHistory(_MAX_SNAPSHOTS, _LEAST_GAP_NS))

    def record(self, poses: PoseHistory, gaussians: Callable[[], Gaussians]) -> None:
        """Take a snapshot of the map after a frame, if one is due."""
        latest = poses.latest()
        if latest is None or not self._snapshots.is_due(latest.capture_time_ns):
            return
        # a map with a value that the codec refuses is still mapped further
        with suppress(InvalidInputError):
            snapshot = MapSnapshot.of(latest.capture_time_ns, gaussians())
            self._snapshots.add(snapshot.time_ns, snapshot)

    def write(self, folder: Path) -> None:
        """Write map_history.safetensors, with the snapshots since the start of this run. Raises StorageError."""
        write_map_history(folder, self._snapshots.states)
