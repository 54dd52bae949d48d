"""Check that the store can write, for the health of the service and the metrics."""

from __future__ import annotations

from gausslite.domain.errors import StorageError
from gausslite.fusion.store import FusionStore

_PROBE_BYTES = 256 << 10
# no agent can have an empty id
_OWNER, RECORD = "", "storage-probe"


class StorageProbe:
    """Writes and deletes a record of the size of a large message. Thread-safe."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._is_writable = True

    @property
    def is_writable(self) -> bool:
        """The result of the latest check; True before the first."""
        return self._is_writable

    def check(self) -> None:
        """Raise StorageError if the store does not take 256 KiB."""
        try:
            self._store.save_record(_OWNER, RECORD, bytes(_PROBE_BYTES))
            # its pages are free again, so that the next check needs new ones if messages have taken them
            self._store.save_record(_OWNER, RECORD, b"")
        except StorageError:
            self._is_writable = False
            raise
        self._is_writable = True
