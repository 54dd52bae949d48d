"""Watch the fused map through restarts of the server, each time from the last complete revision on."""

from __future__ import annotations

import threading
import time

import numpy as np

from gausslite.domain.errors import GaussLiteError, RevisionGoneError
from gausslite.domain.voxels import VoxelBatch, empty_batch
from gausslite.wire.clients import FusionClient

_RETRY_S = 0.1
_POLL_S = 0.05


class MapWatcher:
    """Owns a client, a thread, and the last complete revision of the map."""

    def __init__(self, address: str) -> None:
        self._client = FusionClient(address, deadline_s=60.0)
        self._lock = threading.Lock()
        self._batch, self._revision = empty_batch(), 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map-watcher", daemon=True)
        self._thread.start()

    def wait_for(self, expected: VoxelBatch, timeout_s: float) -> bool:
        """Return whether the watched map gets the voxels, Σkappa and counts of `expected` within this time."""
        limit_s = time.monotonic() + timeout_s
        while not self._has(expected):
            if time.monotonic() > limit_s:
                return False
            self._closing.wait(_POLL_S)
        return True

    def close(self) -> None:
        """End the thread and the connection."""
        self._closing.set()
        self._client.close()
        self._thread.join()

    def _has(self, expected: VoxelBatch) -> bool:
        with self._lock:
            batch = self._batch
        pairs = ((batch.keys, expected.keys), (batch.kappa_sums, expected.kappa_sums), (batch.counts, expected.counts))
        return all(np.array_equal(*pair) for pair in pairs)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._follow()
            except RevisionGoneError:
                self._revision = 0
            except (GaussLiteError, ValueError):  # ValueError: the channel has been closed
                self._closing.wait(_RETRY_S)

    def _follow(self) -> None:
        # what an interrupted revision has changed is dropped, because the next one begins from the last complete one
        batch = self._batch if self._revision else empty_batch()
        for update in self._client.watch(self._revision):
            batch = update.apply_to(batch)
            if update.last:
                with self._lock:
                    self._batch, self._revision = batch, update.revision
