"""The updates that the server has acknowledged: the sequence number of each voxel, to find what a server has lost."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.tile_digests import TileDigests
from gausslite.domain.voxels import tiles_of

SCHEMA = "CREATE TABLE IF NOT EXISTS sent_updates (key INTEGER PRIMARY KEY, update_seq INTEGER NOT NULL);"


class SentUpdateTable:
    """The table in the spool's database. The spool owns the connection, its transactions and its errors."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def record(self, keys: Iterable[int], update_seq: int) -> None:
        """Record that the server has stored the updates of these voxels with this sequence number."""
        self._database.executemany(
            "INSERT OR REPLACE INTO sent_updates VALUES (?, ?)", ((key, update_seq) for key in keys)
        )

    def digests(self) -> TileDigests:
        """Return the digests of all acknowledged updates."""
        return TileDigests.of(*self._columns())

    def forget(self, tiles: Int64[ndarray, " t"]) -> list[int]:
        """Delete the rows of these tiles; returns their voxels."""
        keys, _ = self._columns()
        forgotten: list[int] = keys[np.isin(tiles_of(keys), tiles)].tolist()
        self._database.executemany("DELETE FROM sent_updates WHERE key = ?", ((key,) for key in forgotten))
        return forgotten

    def _columns(self) -> tuple[Int64[ndarray, " k"], Int64[ndarray, " k"]]:
        rows = self._database.execute("SELECT key, update_seq FROM sent_updates").fetchall()
        columns = np.array(rows, np.int64).reshape(-1, 2)
        return columns[:, 0], columns[:, 1]
