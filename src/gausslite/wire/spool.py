"""The uplink's memory: the newest word on every voxel ever offered, what of it the server has, kept across a restart.

It is bounded by the map: a newer word takes the place of the older one on its voxel. With a path it is a SQLite file
that outlives the process; without one it lives in memory.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.records import from_bytes, to_records
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import MismatchError, StorageError

_WIRE_BYTES_PER_GAUSSIAN, _WIRE_BYTES_PER_VOXEL = 20, 20
_MAX_INTEGER = (1 << 63) - 1
_NEVER_SENT = -1
_Row = tuple[int, int, int, int, bytes]
_SCHEMA = """
CREATE TABLE IF NOT EXISTS words (
    key INTEGER PRIMARY KEY, version INTEGER NOT NULL, purpose INTEGER NOT NULL, kappa_sum INTEGER NOT NULL,
    count INTEGER NOT NULL, gaussians BLOB NOT NULL, waiting INTEGER NOT NULL, sent_kappa INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS words_waiting ON words (waiting) WHERE waiting = 1;
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value) WITHOUT ROWID;
"""
_OFFER = """
INSERT INTO words VALUES (?, 1, ?, ?, ?, ?, 1, -1)
ON CONFLICT (key) DO UPDATE SET version = version + 1, purpose = excluded.purpose, kappa_sum = excluded.kappa_sum,
    count = excluded.count, gaussians = excluded.gaussians, waiting = 1
WHERE kappa_sum != excluded.kappa_sum OR gaussians != excluded.gaussians
"""
# what was never sent, and tombstones, go at once; the rest when kappa has grown by a share of what was sent
_PICK = """
SELECT key, version, kappa_sum, count, gaussians FROM words
WHERE waiting = 1 AND purpose = ?
    AND (sent_kappa < 0 OR count = 0 OR abs(kappa_sum - sent_kappa) >= ? * max(sent_kappa, 1))
ORDER BY abs(kappa_sum - sent_kappa) DESC, key
"""


class Purpose(IntEnum):
    """Why a word leaves the robot; ROI words go first."""

    ROI = 1
    HANDOVER = 2


@dataclass(frozen=True, slots=True, eq=False)
class SpoolBatch:
    """Words to send, with the version of each, so that a newer word that comes meanwhile is not taken for sent."""

    purpose: Purpose
    words: VoxelBatch
    versions: Int64[ndarray, " v"]


class Spool:
    """Owns its database. Every method may be called from any thread. All raise StorageError."""

    def __init__(self, path: Path | None, agent_id: str, grid: VoxelGrid) -> None:
        """Open or begin. Raises MismatchError when the file is another agent's or of another grid."""
        self._where = "spool" if path is None else f"spool {path}"
        self._lock = threading.Lock()
        with self._storage_errors():
            self._database = sqlite3.connect(":memory:" if path is None else path, check_same_thread=False)
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = NORMAL")
            self._database.executescript(_SCHEMA)
            self.is_new = self._fact("agent_id") is None
            if self.is_new:
                facts = [("agent_id", agent_id), ("voxel_size_m", grid.size_m), ("stamp", 0)]
                self._database.executemany("INSERT INTO facts VALUES (?, ?)", facts)
                self._database.commit()
            held = self._fact("agent_id"), self._fact("voxel_size_m")
        if held != (agent_id, grid.size_m):
            self.close()
            raise MismatchError(
                f"{self._where}: expected agent {agent_id!r} and voxels of {grid.size_m} m, "
                f"got {held[0]!r} and {held[1]} m; choose another file"
            )

    def enqueue(self, words: VoxelBatch, purpose: Purpose) -> None:
        """Keep these words in place of older ones on their voxels; what is unchanged stays as it was."""
        records = to_records(words.gaussians)
        offsets = words.offsets.tolist()
        sums = np.minimum(words.kappa_sums, np.uint64(_MAX_INTEGER)).tolist()
        with self._transaction():
            self._database.executemany(
                _OFFER,
                (
                    (
                        key,
                        int(purpose),
                        sums[i],
                        offsets[i + 1] - offsets[i],
                        records[offsets[i] : offsets[i + 1]].tobytes(),
                    )
                    for i, key in enumerate(words.keys.tolist())
                ),
            )

    def next_batch(self, max_bytes: int, resend_threshold: float) -> SpoolBatch | None:
        """Waiting words whose kappa grew most, for about max_bytes on the wire but at least one; None when none is due.

        A word already sent is due once its kappa has changed by resend_threshold of what was sent.
        """
        for purpose in Purpose:
            with self._transaction():
                rows: list[_Row] = []
                spent = 0
                for row in self._database.execute(_PICK, (int(purpose), resend_threshold)):
                    spent += _WIRE_BYTES_PER_VOXEL + row[3] * _WIRE_BYTES_PER_GAUSSIAN
                    if rows and spent > max_bytes:
                        break
                    rows.append(row)
            if rows:
                return _picked(purpose, sorted(rows))
        return None

    def mark_acked(self, picked: SpoolBatch) -> None:
        """These words need not be sent again: the server has them, or will never take them."""
        triples = zip(
            picked.versions.tolist(), picked.words.kappa_sums.tolist(), picked.words.keys.tolist(), strict=True
        )
        with self._transaction():
            self._database.executemany(
                "UPDATE words SET waiting = (version != ?), sent_kappa = ? WHERE key = ?", triples
            )

    def mark_all_unsent(self) -> None:
        """The server lost it: every word waits again."""
        with self._transaction():
            self._database.execute("UPDATE words SET waiting = 1, sent_kappa = ?", (_NEVER_SENT,))

    @property
    def waiting(self) -> int:
        """Voxels with a word the server does not have."""
        with self._transaction():
            return int(self._database.execute("SELECT count(*) FROM words WHERE waiting = 1").fetchone()[0])

    def next_update_seq(self, at_least: int = 0) -> int:
        """A number above all it gave before, in this life or an earlier one, and above at_least."""
        with self._transaction():
            stamp = max(int(self._fact("stamp") or 0), at_least) + 1
            self._database.execute("UPDATE facts SET value = ? WHERE name = 'stamp'", (stamp,))
        return stamp

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            self._database.close()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, self._storage_errors(), self._database:
            yield

    @contextmanager
    def _storage_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StorageError(f"{self._where}: {error}; free some space or choose another file") from error

    def _fact(self, name: str) -> str | float | None:
        row = self._database.execute("SELECT value FROM facts WHERE name = ?", (name,)).fetchone()
        return None if row is None else row[0]


def _picked(purpose: Purpose, rows: list[_Row]) -> SpoolBatch:
    keys, versions, sums, counts, blobs = zip(*rows, strict=True)
    words = VoxelBatch(
        np.array(keys, np.int64),
        np.array(sums, np.uint64),
        np.array(counts, np.uint32),
        from_bytes(b"".join(blobs)),
    )
    return SpoolBatch(purpose, words, np.array(versions, np.int64))
