"""Follow a service's map in the background: the newest complete revision at any time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.voxels import VoxelBatch, empty_batch
from gausslite.wire.convert import MapUpdate

_RETRY_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class FollowedMap:
    """A service's map at one revision. winners: the agent of each voxel, by key; empty for the map of one agent."""

    revision: int
    batch: VoxelBatch
    winners: dict[int, str]


class MapFollower:
    """Owns the thread that reads a map's updates, and connects again after an error."""

    def __init__(self, watch: Callable[[], Iterator[MapUpdate]]) -> None:
        self._watch = watch
        self._lock = threading.Lock()
        self._newest: FollowedMap | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map-follower", daemon=True)
        self._thread.start()

    def newest(self) -> FollowedMap | None:
        """Return the newest complete revision, None before the first."""
        with self._lock:
            return self._newest

    def close(self) -> None:
        """End the thread. Close the client first, which ends its wait for updates."""
        self._stopped.set()
        self._thread.join(_RETRY_S)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                self._follow()
            except (GaussLiteError, ValueError):  # ValueError: the channel has been closed
                self._stopped.wait(_RETRY_S)

    def _follow(self) -> None:
        batch, winners = empty_batch(), dict[int, str]()
        for update in self._watch():
            if update.snapshot and update.first:
                winners = {}
            batch = update.apply_to(batch)
            if update.batch is not None and update.winners:
                winners.update(zip(update.batch.keys.tolist(), update.winners, strict=True))
            if update.last:
                with self._lock:
                    self._newest = FollowedMap(update.revision, batch, dict(winners))
            if self._stopped.is_set():
                return
