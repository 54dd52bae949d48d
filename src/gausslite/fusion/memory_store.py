"""The store of voxel updates in memory: for one mission, lost when the process ends."""

from __future__ import annotations

from gausslite.fusion.sqlite_store import IN_MEMORY, SqliteStore


class MemoryStore(SqliteStore):
    """An SQLite database without a file."""

    def __init__(self) -> None:
        super().__init__(IN_MEMORY)
