"""Store the uplink's data: the latest update of every voxel, and whether it is pending.

An update is pending until the server has accepted or finally refused it. A pending update is due if it has never been
sent, is a tombstone, or its Σkappa has changed enough since it was last sent. The spool's size is bounded by the map,
because a newer update replaces the older one of its voxel. With a path it is a SQLite file that survives a restart;
otherwise it is in memory.
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
from gausslite.domain.errors import MismatchError, StorageError
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxels import VoxelGrid

_WIRE_BYTES_PER_GAUSSIAN, _WIRE_BYTES_PER_VOXEL = 20, 20
_MAX_INTEGER = (1 << 63) - 1
_NEVER_SENT = -1
_Row = tuple[int, int, int, int, bytes]
_SCHEMA = """
CREATE TABLE IF NOT EXISTS voxel_updates (
    key INTEGER PRIMARY KEY, version INTEGER NOT NULL, purpose INTEGER NOT NULL, kappa_sum INTEGER NOT NULL,
    count INTEGER NOT NULL, gaussians BLOB NOT NULL, pending INTEGER NOT NULL, sent_kappa INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS voxel_updates_pending ON voxel_updates (pending) WHERE pending = 1;
CREATE TABLE IF NOT EXISTS properties (name TEXT PRIMARY KEY, value) WITHOUT ROWID;
"""
_ENQUEUE = """
INSERT INTO voxel_updates VALUES (?, 1, ?, ?, ?, ?, 1, -1)
ON CONFLICT (key) DO UPDATE SET version = version + 1, purpose = excluded.purpose, kappa_sum = excluded.kappa_sum,
    count = excluded.count, gaussians = excluded.gaussians, pending = 1
WHERE kappa_sum != excluded.kappa_sum OR gaussians != excluded.gaussians
"""
# updates never sent and tombstones are due at once; others if Σkappa has changed by a share of the sent value
_SELECT_DUE = """
SELECT key, version, kappa_sum, count, gaussians FROM voxel_updates
WHERE pending = 1 AND purpose = ?
    AND (sent_kappa < 0 OR count = 0 OR abs(kappa_sum - sent_kappa) >= ? * max(sent_kappa, 1))
ORDER BY abs(kappa_sum - sent_kappa) DESC, key
"""


class Purpose(IntEnum):
    """Why a voxel is sent; ROI voxels are sent first."""

    ROI = 1
    HANDOVER = 2


@dataclass(frozen=True, slots=True, eq=False)
class SpoolBatch:
    """Updates to send, with their versions; a newer update of a voxel has a higher version and stays pending."""

    purpose: Purpose
    batch: VoxelBatch
    versions: Int64[ndarray, " v"]


class Spool:
    """Owns the database. Thread-safe. All methods raise StorageError."""

    def __init__(self, path: Path | None, agent_id: str, grid: VoxelGrid) -> None:
        """Open or create the spool. Raises MismatchError if the file is another agent's or of another grid."""
        self._error_prefix = "spool" if path is None else f"spool {path}"
        self._lock = threading.Lock()
        with self._storage_errors():
            self._database = sqlite3.connect(":memory:" if path is None else path, check_same_thread=False)
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = NORMAL")
            self._database.executescript(_SCHEMA)
            self.is_new = self._property("agent_id") is None
            if self.is_new:
                properties = [("agent_id", agent_id), ("voxel_size_m", grid.size_m), ("update_seq", 0)]
                self._database.executemany("INSERT INTO properties VALUES (?, ?)", properties)
                self._database.commit()
            stored = self._property("agent_id"), self._property("voxel_size_m")
        if stored != (agent_id, grid.size_m):
            self.close()
            raise MismatchError(
                f"{self._error_prefix}: expected agent {agent_id!r} and voxels of {grid.size_m} m, "
                f"got {stored[0]!r} and {stored[1]} m; choose another file"
            )

    def enqueue(self, batch: VoxelBatch, purpose: Purpose) -> None:
        """Replace the stored updates of these voxels; an update equal to the stored one changes nothing."""
        records = to_records(batch.gaussians)
        offsets = batch.offsets.tolist()
        sums = np.minimum(batch.kappa_sums, np.uint64(_MAX_INTEGER)).tolist()
        with self._transaction():
            self._database.executemany(
                _ENQUEUE,
                (
                    (
                        key,
                        int(purpose),
                        sums[i],
                        offsets[i + 1] - offsets[i],
                        records[offsets[i] : offsets[i + 1]].tobytes(),
                    )
                    for i, key in enumerate(batch.keys.tolist())
                ),
            )

    def next_batch(self, max_bytes: int, resend_threshold: float) -> SpoolBatch | None:
        """Return the due voxels with the largest change of Σkappa, about max_bytes, at least one; None if none is due.

        A voxel sent before is due if its Σkappa has changed by the share resend_threshold of the sent value.
        """
        for purpose in Purpose:
            with self._transaction():
                rows: list[_Row] = []
                spent = 0
                for row in self._database.execute(_SELECT_DUE, (int(purpose), resend_threshold)):
                    spent += _WIRE_BYTES_PER_VOXEL + row[3] * _WIRE_BYTES_PER_GAUSSIAN
                    if rows and spent > max_bytes:
                        break
                    rows.append(row)
            if rows:
                return _to_batch(purpose, sorted(rows))
        return None

    def mark_done(self, sent: SpoolBatch) -> None:
        """Mark these versions as no longer pending, because the server has accepted or finally refused them."""
        triples = zip(sent.versions.tolist(), sent.batch.kappa_sums.tolist(), sent.batch.keys.tolist(), strict=True)
        with self._transaction():
            self._database.executemany(
                "UPDATE voxel_updates SET pending = (version != ?), sent_kappa = ? WHERE key = ?", triples
            )

    def mark_all_unsent(self) -> None:
        """Mark every voxel as pending and never sent, because the server has lost all updates."""
        with self._transaction():
            self._database.execute("UPDATE voxel_updates SET pending = 1, sent_kappa = ?", (_NEVER_SENT,))

    @property
    def pending_voxels(self) -> int:
        """The number of voxels whose latest update is pending."""
        with self._transaction():
            return int(self._database.execute("SELECT count(*) FROM voxel_updates WHERE pending = 1").fetchone()[0])

    def next_update_seq(self, above: int = 0) -> int:
        """Return a number greater than `above` and than all earlier numbers, also those from before a restart."""
        with self._transaction():
            update_seq = max(int(self._property("update_seq") or 0), above) + 1
            self._database.execute("UPDATE properties SET value = ? WHERE name = 'update_seq'", (update_seq,))
        return update_seq

    def close(self) -> None:
        """Close the database."""
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
            raise StorageError(f"{self._error_prefix}: {error}; free some space or choose another file") from error

    def _property(self, name: str) -> str | float | None:
        row = self._database.execute("SELECT value FROM properties WHERE name = ?", (name,)).fetchone()
        return None if row is None else row[0]


def _to_batch(purpose: Purpose, rows: list[_Row]) -> SpoolBatch:
    keys, versions, sums, counts, blobs = zip(*rows, strict=True)
    batch = VoxelBatch(
        np.array(keys, np.int64),
        np.array(sums, np.uint64),
        np.array(counts, np.uint32),
        from_bytes(b"".join(blobs)),
    )
    return SpoolBatch(purpose, batch, np.array(versions, np.int64))
