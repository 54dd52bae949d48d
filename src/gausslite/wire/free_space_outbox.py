"""The blocks of free space that wait for the fusion server."""

from __future__ import annotations

from threading import Lock

from gausslite.domain.free_space import FreeSpace


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

    def take(self) -> FreeSpace:
        """Return the blocks to send; they no longer wait."""
        with self._lock:
            taken, self._pending = self._pending, FreeSpace.empty()
            return taken

    def put_back(self, blocks: FreeSpace) -> None:
        """Let blocks wait again that were not sent, unless newer ones do."""
        with self._lock:
            self._pending = blocks.replace_blocks(self._pending)

    def mark_unsent(self) -> None:
        """Let all blocks wait, because the server has lost them."""
        with self._lock:
            self._pending = self._all
