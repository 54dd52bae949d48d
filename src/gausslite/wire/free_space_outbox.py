"""The blocks of free space that wait for the fusion server."""

from __future__ import annotations

import logging
from threading import Lock

from gausslite.domain.errors import GaussLiteError, InvalidInputError, QuotaError
from gausslite.domain.free_space import FreeSpace
from gausslite.domain.voxels import VoxelGrid
from gausslite.wire.clients import FusionClient

_log = logging.getLogger(__name__)


class FreeSpaceOutbox:
    """Holds all blocks of this agent, and which of them the server does not have. Thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._all, self._pending = FreeSpace.empty(), FreeSpace.empty()

    def put(self, blocks: FreeSpace) -> None:
        """Add blocks; they replace earlier ones of the same place."""
        with self._lock:
            self._all, self._pending = self._all.replace_blocks(blocks), self._pending.replace_blocks(blocks)

    @property
    def has_pending(self) -> bool:
        """Return whether a block has to be sent."""
        return len(self._pending.keys) > 0

    def send(self, client: FusionClient, session_id: str, grid: VoxelGrid) -> int:
        """Send the blocks that wait; returns the bytes. Raises GaussLiteError, and then they wait again.

        Rejected blocks are dropped, because the map does not depend on them.
        """
        with self._lock:
            blocks, self._pending = self._pending, FreeSpace.empty()
        if not len(blocks.keys):
            return 0
        try:
            return client.contribute_free_space(session_id, blocks, grid)
        except (InvalidInputError, QuotaError) as error:
            _log.warning("uplink: free space is dropped: %s", error)
            return 0
        except GaussLiteError:
            with self._lock:
                self._pending = blocks.replace_blocks(self._pending)
            raise

    def mark_unsent(self) -> None:
        """Let all blocks wait, because the server has lost them."""
        with self._lock:
            self._pending = self._all
