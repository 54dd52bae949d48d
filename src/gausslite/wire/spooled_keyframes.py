"""The keyframes of a spool: encoded images that wait for the fusion server, and those that it has.

All keyframes that the agent has selected stay in the spool, also after they were sent. A server may lose its data, and
a restarted agent needs the list of its selected keyframes. The agent limits their number.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

SCHEMA = """
CREATE TABLE IF NOT EXISTS keyframes (
    frame_index INTEGER PRIMARY KEY, enqueue_count INTEGER NOT NULL, value REAL NOT NULL, coverage BLOB NOT NULL,
    data BLOB NOT NULL, pending INTEGER NOT NULL);
"""
_ENQUEUE = """
INSERT INTO keyframes VALUES (?, 1, ?, ?, ?, 1)
ON CONFLICT (frame_index) DO UPDATE SET enqueue_count = enqueue_count + 1, value = excluded.value,
    coverage = excluded.coverage, data = excluded.data, pending = 1
"""
_SELECT_PENDING = """
SELECT frame_index, enqueue_count, value, coverage, data FROM keyframes WHERE pending = 1
ORDER BY value / length(data) DESC, frame_index
"""


@dataclass(frozen=True, slots=True)
class SpooledKeyframe:
    """A keyframe to send.

    value: what the server gains, in units of kappa. coverage: what the agent needs to know of it after a restart; the
    spool does not read it. data: the EncodedFrame. enqueue_count: how often this frame was enqueued.
    """

    frame_index: int
    value: float
    coverage: bytes
    data: bytes
    enqueue_count: int = 0

    @property
    def value_per_byte(self) -> float:
        """The order of sending."""
        return self.value / len(self.data)


class KeyframeTable:
    """The table in the spool's database. The spool owns the connection, its transactions and its errors."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def enqueue(self, keyframe: SpooledKeyframe) -> None:
        """Store a keyframe as pending; it replaces one of the same index."""
        row = (keyframe.frame_index, keyframe.value, keyframe.coverage, keyframe.data)
        self._database.execute(_ENQUEUE, row)

    def remove(self, frame_index: int) -> None:
        """Delete a keyframe."""
        self._database.execute("DELETE FROM keyframes WHERE frame_index = ?", (frame_index,))

    def pending(self) -> Iterator[SpooledKeyframe]:
        """Yield the pending keyframes, the highest value per byte first."""
        for index, enqueue_count, value, coverage, data in self._database.execute(_SELECT_PENDING):
            yield SpooledKeyframe(index, value, coverage, data, enqueue_count)

    def stored(self) -> list[SpooledKeyframe]:
        """Return all keyframes, in the order of their indices."""
        query = "SELECT frame_index, value, coverage, data, enqueue_count FROM keyframes ORDER BY frame_index"
        return [SpooledKeyframe(*row) for row in self._database.execute(query)]

    def indices(self) -> tuple[int, ...]:
        """Return the indices of all keyframes, ascending."""
        query = "SELECT frame_index FROM keyframes ORDER BY frame_index"
        return tuple(index for (index,) in self._database.execute(query))

    def count_pending(self) -> int:
        """Return the number of pending keyframes."""
        return int(self._database.execute("SELECT count(*) FROM keyframes WHERE pending = 1").fetchone()[0])

    def mark_done(self, keyframes: Iterable[SpooledKeyframe]) -> None:
        """Mark these keyframes as no longer pending."""
        pairs = [(keyframe.enqueue_count, keyframe.frame_index) for keyframe in keyframes]
        self._database.executemany("UPDATE keyframes SET pending = (enqueue_count != ?) WHERE frame_index = ?", pairs)

    def mark_missing(self, stored: Iterable[int]) -> None:
        """Mark every keyframe as pending that the server does not store."""
        self._database.execute("CREATE TEMP TABLE IF NOT EXISTS stored (frame_index INTEGER PRIMARY KEY)")
        self._database.execute("DELETE FROM stored")
        self._database.executemany("INSERT OR IGNORE INTO stored VALUES (?)", ((index,) for index in stored))
        self._database.execute(
            "UPDATE keyframes SET pending = 1 WHERE frame_index NOT IN (SELECT frame_index FROM stored)"
        )
