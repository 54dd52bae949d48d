"""Store the latest update of every voxel and the selected keyframes for the uplink, and whether they are pending.

An update is pending until the server has accepted it or permanently rejected it. A pending update is due if its voxel
was never sent, has lost all Gaussians or a quarter of its Σkappa, or if its Σkappa has grown enough since then, in
proportion to the sent one: training changes a voxel less and less. A newer update replaces the older one of its voxel,
so the map bounds the spool. With a path, it is a SQLite file that survives a restart; otherwise in memory.

Updates and keyframes share one bandwidth: the highest value per byte is sent first. The value of an update is the
change of Σkappa, the number of optimiser updates that the server lacks. The value of a keyframe has the same unit.

All keyframes that the agent has selected stay in the spool, also after they were sent. A server may lose its data, and
a restarted agent needs the list of its selected keyframes. The agent limits their number.
"""

from __future__ import annotations

import heapq
import json
import logging
import math
import os
import secrets
import sqlite3
import threading
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.commit_head import COUNT_COMMIT, CommitHead
from gausslite.codec.encoded_voxels import from_records, to_records
from gausslite.domain.errors import MismatchError, StorageError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, tiles_of

_log = logging.getLogger(__name__)
_WIRE_BYTES_PER_GAUSSIAN, _WIRE_BYTES_PER_VOXEL = 20, 20
_MAX_INTEGER = (1 << 63) - 1
_SLICE = 500
"""Pending voxels that are compared while the lock is held: about a millisecond."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS voxel_updates (
    key INTEGER PRIMARY KEY, enqueue_count INTEGER NOT NULL, purpose INTEGER NOT NULL, kappa_sum INTEGER NOT NULL,
    count INTEGER NOT NULL, gaussians BLOB NOT NULL, pending INTEGER NOT NULL, sent_kappa INTEGER NOT NULL,
    acknowledged_seq INTEGER, checksum INTEGER);
CREATE TABLE IF NOT EXISTS keyframes (
    frame_index INTEGER PRIMARY KEY, enqueue_count INTEGER NOT NULL, value REAL NOT NULL, coverage BLOB NOT NULL,
    data BLOB NOT NULL, pending INTEGER NOT NULL, checksum INTEGER);
CREATE TABLE IF NOT EXISTS properties (name TEXT PRIMARY KEY, value) WITHOUT ROWID;
"""
_ENQUEUE = """
INSERT INTO voxel_updates
    (key, enqueue_count, purpose, kappa_sum, count, gaussians, pending, sent_kappa, checksum)
VALUES (?, 1, ?, ?, ?, ?, 1, -1, ?)
ON CONFLICT (key) DO UPDATE SET enqueue_count = enqueue_count + 1, purpose = excluded.purpose,
    kappa_sum = excluded.kappa_sum, count = excluded.count, gaussians = excluded.gaussians, pending = 1,
    checksum = excluded.checksum
WHERE kappa_sum != excluded.kappa_sum OR gaussians != excluded.gaussians
"""
# a byte's value with the opposite sign, so that value and key ascend together
_SORTED = f"""
ALTER TABLE voxel_updates ADD COLUMN place REAL AS
    (-abs(kappa_sum - sent_kappa) / ({_WIRE_BYTES_PER_VOXEL}.0 + {_WIRE_BYTES_PER_GAUSSIAN}.0 * count)) VIRTUAL;
CREATE INDEX voxel_updates_by_value ON voxel_updates (purpose, place, key) WHERE pending = 1;
DROP INDEX IF EXISTS voxel_updates_pending;
"""
# of what is sent; the other columns say when it is sent
_CHECKSUMS = {"voxel_updates": "crc(key, kappa_sum, count, gaussians)", "keyframes": "crc(frame_index, coverage, data)"}
_DAMAGED = (
    "is damaged ({}); move it and its log away to begin with an empty one: an agent with --state sends its saved map "
    "again, other updates and keyframes that the server has not acknowledged are lost"
)
_SELECT_SLICE = f"""
SELECT place, key, {_WIRE_BYTES_PER_VOXEL} + {_WIRE_BYTES_PER_GAUSSIAN} * count,
    sent_kappa < 0 OR count = 0 OR kappa_sum <= 0.75 * sent_kappa
        OR abs(kappa_sum - sent_kappa) >= ? * max(sent_kappa, 1)
FROM voxel_updates WHERE pending = 1 AND purpose = ? AND place %s ORDER BY place, key LIMIT {_SLICE}
"""  # noqa: S608 - constants of this file
_SELECT_EQUAL, _SELECT_NEXT = (_SELECT_SLICE % condition for condition in ("= ? AND key > ?", "> ?"))
_RESEND = "UPDATE voxel_updates SET pending = 1, sent_kappa = -1, acknowledged_seq = NULL WHERE key = ?"
_SELECT_PENDING = """
SELECT key, enqueue_count, kappa_sum, count, gaussians FROM voxel_updates WHERE key = ? AND pending = 1
"""
_ENQUEUE_KEYFRAME = """
INSERT INTO keyframes VALUES (?, 1, ?, ?, ?, 1, ?)
ON CONFLICT (frame_index) DO UPDATE SET enqueue_count = enqueue_count + 1, value = excluded.value,
    coverage = excluded.coverage, data = excluded.data, pending = 1, checksum = excluded.checksum
"""
_SELECT_KEYFRAMES = "SELECT frame_index, value, coverage, data, enqueue_count FROM keyframes"
_DUE_KEYFRAMES = """
SELECT -value / length(data), frame_index, length(data), 1 FROM keyframes WHERE pending = 1 ORDER BY 1, 2
"""


@dataclass(frozen=True, slots=True)
class SpooledKeyframe:
    """A keyframe to send."""

    frame_index: int
    value: float  # what the server gains, in units of kappa
    coverage: bytes  # what the agent needs to know of it after a restart; the spool does not read it
    data: bytes  # the EncodedFrame
    enqueue_count: int = 0  # how often this frame was enqueued


class _Due(NamedTuple):
    """A pending voxel or keyframe in the order of sending, with its size on the wire."""

    place: float
    key: int
    size_bytes: int
    is_keyframe: bool = False


class Purpose(IntEnum):
    """Why a voxel is sent; ROI voxels are sent first."""

    ROI = 1
    HANDOVER = 2


@dataclass(frozen=True, slots=True, eq=False)
class SpoolBatch:
    """Updates to send.

    enqueue_counts: how often each voxel had been enqueued. If the stored count is higher when the answer arrives, a
    newer update of the voxel is pending.
    """

    purpose: Purpose  # the region, or the handover
    batch: VoxelBatch
    enqueue_counts: Int64[ndarray, " v"]


@dataclass(frozen=True, slots=True, eq=False)
class SpoolRound:
    """What is sent in one round."""

    voxels: SpoolBatch | None
    keyframes: tuple[SpooledKeyframe, ...]


class Spool:
    """Owns the database. Thread-safe. All methods raise StorageError."""

    def __init__(self, path: Path | None, agent_id: str, grid: VoxelGrid) -> None:
        """Open or create the spool. Raises MismatchError if the file is another agent's or of another grid."""
        self._path, self.agent_id = path, agent_id
        self._error_prefix = "spool" if path is None else f"spool {path}"
        self._lock = threading.RLock()
        self._head, self._commits, self.token = CommitHead(path), 0, ""
        with self._storage_errors():
            if path is not None:
                path.touch(0o600)
            self._database = sqlite3.connect(":memory:" if path is None else path, check_same_thread=False)
            self._database.create_function("crc", -1, _crc, deterministic=True)
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.execute("PRAGMA synchronous = NORMAL")  # the head tells what a power failure has lost
            self._check_pages()
            self._database.executescript(_SCHEMA)
            self._add_new_columns()
            self._check_rows()
            self.is_new = self._property("agent_id") is None
            if self.is_new:
                properties = [("agent_id", agent_id), ("voxel_size_m", grid.size_m), ("update_seq", 0)]
                properties += [("token", secrets.token_hex(16)), ("commits", 1)]
                self._database.executemany("INSERT INTO properties VALUES (?, ?)", properties)
                self._database.commit()
            stored = self._property("agent_id"), self._property("voxel_size_m")
            # with this secret, a restarted robot takes its own name back before the lease has ended
            self.token = str(self._property("token"))
        if stored != (agent_id, grid.size_m):
            self.close()
            raise MismatchError(
                f"{self._error_prefix}: expected agent {agent_id!r} and voxels of {grid.size_m} m, "
                f"got {stored[0]!r} and {stored[1]} m; choose another file"
            )
        self._begin_head()

    def _begin_head(self) -> None:
        """Warn if the head knows more commits than the file; from then on the head follows the file."""
        last, self._commits = self._head.read(), int(self._property("commits") or 0)
        is_lost = last is None and self._commits > 0 and not self.is_new
        if is_lost or (last is not None and (last[0] != self.token or last[1] > self._commits)):
            _log.warning(
                "%s: may lack its last updates (its log or its head is missing or damaged, or another file is in its "
                "place); they are sent when their voxels change again",
                self._error_prefix,
            )
        self._head.write(self.token, self._commits)

    def _check_pages(self) -> None:
        found = self._database.execute("PRAGMA quick_check(1)").fetchone()[0]
        if found != "ok":
            raise StorageError(f"{self._error_prefix}: {_DAMAGED.format(' '.join(found.split()))}")

    def _check_rows(self) -> None:
        for table, checksum in _CHECKSUMS.items():
            query = f"SELECT count(*) FROM {table} WHERE checksum IS NOT {checksum}"  # noqa: S608
            [[damaged]] = self._database.execute(query)
            if damaged:
                raise StorageError(f"{self._error_prefix}: {_DAMAGED.format(f'{damaged} rows of {table}')}")

    def _add_new_columns(self) -> None:
        """Bring the tables of the two versions before up to date, and order them."""
        columns = [row[1] for row in self._database.execute("PRAGMA table_xinfo (voxel_updates)")]
        if "acknowledged_seq" not in columns:
            raise StorageError(f"{self._error_prefix}: of another release; let that one send it, or move it away")
        if "place" not in columns:
            self._database.executescript(_SORTED)
        for table, checksum in _CHECKSUMS.items() if "checksum" not in columns else ():
            self._database.execute(f"ALTER TABLE {table} ADD COLUMN checksum INTEGER")
            self._database.execute(f"UPDATE {table} SET checksum = {checksum}")  # noqa: S608
            self._database.commit()

    def enqueue(self, batch: VoxelBatch, purpose: Purpose) -> None:
        """Replace the stored updates of these voxels; an update equal to the stored one changes nothing."""
        records = to_records(batch.gaussians)
        offsets = batch.offsets.tolist()
        sums = np.minimum(batch.kappa_sums, np.uint64(_MAX_INTEGER)).tolist()
        values = (
            (key, kappa_sum, stop - start, records[start:stop].tobytes())
            for key, kappa_sum, (start, stop) in zip(batch.keys.tolist(), sums, pairwise(offsets), strict=True)
        )
        self._update(_ENQUEUE, ((own[0], int(purpose), *own[1:], _crc(*own)) for own in values))

    def voxels(self, purpose: Purpose | None = None) -> Int64[ndarray, " v"]:
        """Return the keys of the voxels whose latest update has Gaussians, ascending; purpose: only updates for it."""
        query = "SELECT key FROM voxel_updates WHERE count > 0 AND (? IS NULL OR purpose = ?) ORDER BY key"
        return np.array(self._select(query, purpose, purpose), np.int64).reshape(-1)

    def next_round(self, max_bytes: int, resend_threshold: float) -> SpoolRound | None:
        """Return what is due with the highest value per byte, about max_bytes, at least one; None if nothing is due.

        A voxel that was sent is due if its Σkappa has changed by resend_threshold times the sent value, or has lost a
        quarter. Voxels of the handover follow when nothing else is due.
        """
        keyframes = [_Due(*row) for row in self._select(_DUE_KEYFRAMES)]
        # both are sorted by value per byte
        due = heapq.merge(self._due_voxels(Purpose.ROI, resend_threshold), keyframes, key=lambda due: due.place)
        purpose, chosen = Purpose.ROI, _take(due, max_bytes)
        if not chosen:
            purpose, chosen = Purpose.HANDOVER, _take(self._due_voxels(Purpose.HANDOVER, resend_threshold), max_bytes)
        if not chosen:
            return None
        # one key at a time, so that others may use the spool meanwhile
        keys = sorted({item.key for item in chosen if not item.is_keyframe})
        rows = [row for key in keys for row in self._select(_SELECT_PENDING, key)]
        query = f"{_SELECT_KEYFRAMES} WHERE frame_index = ?"
        frames = [row for item in chosen if item.is_keyframe for row in self._select(query, item.key)]
        return SpoolRound(_to_batch(purpose, rows), tuple(SpooledKeyframe(*row) for row in frames))

    def enqueue_keyframe(self, keyframe: SpooledKeyframe, replaced: int | None = None) -> None:
        """Store a selected keyframe as pending, and delete the one that it replaces in the selection."""
        with self._transaction():
            self._database.execute("DELETE FROM keyframes WHERE frame_index = ?", (replaced,))
            index, value, coverage, data = keyframe.frame_index, keyframe.value, keyframe.coverage, keyframe.data
            row = index, value, coverage, data, _crc(index, coverage, data)
            self._database.execute(_ENQUEUE_KEYFRAME, row)

    def mark_keyframes_done(self, keyframes: Iterable[SpooledKeyframe]) -> None:
        """Mark these keyframes as not pending, because the server has accepted or permanently rejected them."""
        pairs = [(keyframe.enqueue_count, keyframe.frame_index) for keyframe in keyframes]
        self._update("UPDATE keyframes SET pending = (enqueue_count != ?) WHERE frame_index = ?", pairs)

    def mark_keyframes_missing(self, stored: Iterable[int]) -> None:
        """Mark all keyframes as pending except those with these indices, which the server stores."""
        missing = "UPDATE keyframes SET pending = 1 WHERE frame_index NOT IN (SELECT value FROM json_each(?))"
        self._update(missing, [(json.dumps(list(stored)),)])

    def keyframes(self) -> list[SpooledKeyframe]:
        """Return all keyframes, in the order of their indices."""
        return [SpooledKeyframe(*row) for row in self._select(f"{_SELECT_KEYFRAMES} ORDER BY frame_index")]

    def keyframe_indices(self) -> tuple[int, ...]:
        """Return the indices of all keyframes, ascending."""
        return tuple(index for (index,) in self._select("SELECT frame_index FROM keyframes ORDER BY frame_index"))

    @property
    def pending_keyframes(self) -> int:
        """The number of pending keyframes."""
        return int(self._select("SELECT count(*) FROM keyframes WHERE pending = 1")[0][0])

    def is_stored_by(self, incarnation_id: str, highest_update_seq: int) -> bool:
        """Return whether a server with this content has every update that was acknowledged to this spool."""
        with self._transaction():
            acknowledged = int(self._property("acknowledged_seq") or 0)
            return self._property("incarnation_id") == incarnation_id and highest_update_seq >= acknowledged

    def acknowledged_digests(self) -> TileDigests:
        """Return the digests of the updates that were acknowledged."""
        return TileDigests.of(*self._acknowledged())

    def begin_sending_to(self, incarnation_id: str, highest_update_seq: int, lost: Int64[ndarray, " t"]) -> int:
        """Mark the voxels of the tiles in `lost` as pending and never sent; returns their number.

        The server with this content has all acknowledged updates of the other tiles.
        """
        with self._transaction():
            keys, _ = self._acknowledged()
            keys = keys[np.isin(tiles_of(keys), lost)]
            # no more than the server claims
            acknowledged = min(int(self._property("acknowledged_seq") or 0), highest_update_seq)
            # as never sent: no threshold delays them
            self._database.executemany(_RESEND, ((key,) for key in keys.tolist()))
            properties = [("incarnation_id", incarnation_id), ("acknowledged_seq", acknowledged)]
            self._database.executemany("INSERT OR REPLACE INTO properties VALUES (?, ?)", properties)
        return len(keys)

    def record_acknowledged(self, keys: Int64[ndarray, " v"], update_seq: int) -> None:
        """Record that the server has stored the updates of these voxels, with this sequence number."""
        with self._transaction():
            stored = ((update_seq, key) for key in keys.tolist())
            self._database.executemany("UPDATE voxel_updates SET acknowledged_seq = ? WHERE key = ?", stored)
            self._database.execute(
                "UPDATE properties SET value = max(value, ?) WHERE name = 'acknowledged_seq'", (update_seq,)
            )

    def mark_done(self, sent: SpoolBatch) -> None:
        """Mark these updates as not pending, because the server has accepted or permanently rejected them."""
        batch = sent.batch
        triples = zip(sent.enqueue_counts.tolist(), batch.kappa_sums.tolist(), batch.keys.tolist(), strict=True)
        self._update("UPDATE voxel_updates SET pending = (enqueue_count != ?), sent_kappa = ? WHERE key = ?", triples)

    @property
    def pending_voxels(self) -> int:
        """The number of voxels whose latest update is pending."""
        return int(self._select("SELECT count(*) FROM voxel_updates WHERE pending = 1")[0][0])

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
            self._head.close()

    def _due_voxels(self, purpose: Purpose, resend_threshold: float) -> Iterator[_Due]:
        """Yield the due voxels, those of the highest value first. Between two slices, others may use the spool."""
        order = resend_threshold, int(purpose)
        place, key = -math.inf, 0
        while rows := self._select(_SELECT_EQUAL, *order, place, key) or self._select(_SELECT_NEXT, *order, place):
            for place, key, size_bytes, is_due in rows:
                if is_due:
                    yield _Due(place, key, size_bytes)

    def _acknowledged(self) -> tuple[Int64[ndarray, " k"], Int64[ndarray, " k"]]:
        """Return the voxels whose updates the server has stored, and the sequence numbers of these."""
        query = "SELECT key, acknowledged_seq FROM voxel_updates WHERE acknowledged_seq IS NOT NULL"
        columns = np.array(self._select(query), np.int64).reshape(-1, 2)
        return columns[:, 0], columns[:, 1]

    def _select(self, query: str, *parameters: object) -> list[tuple[Any, ...]]:
        with self._transaction():
            return self._database.execute(query, parameters).fetchall()

    def _update(self, query: str, rows: Iterable[tuple[Any, ...]]) -> None:
        with self._transaction():
            self._database.executemany(query, rows)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, self._storage_errors(), self._database:
            yield
            if self._database.in_transaction:
                self._database.execute(COUNT_COMMIT)
                self._database.commit()
                self._commits += 1
                self._head.write(self.token, self._commits)

    @contextmanager
    def _storage_errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            if "malformed" in str(error) or "not a database" in str(error):
                raise StorageError(f"{self._error_prefix}: {_DAMAGED.format(error)}") from error
            advice = "free some space or choose another file"
            if self._path is not None and not os.access(self._path.absolute().parent, os.W_OK):
                advice = f"expected a file in a folder that user {os.geteuid()} can write"
            raise StorageError(f"{self._error_prefix}: {error}; {advice}") from error

    def _property(self, name: str) -> str | float | None:
        row = self._database.execute("SELECT value FROM properties WHERE name = ?", (name,)).fetchone()
        return None if row is None else row[0]


def _crc(*values: int | bytes) -> int:
    """Return the CRC-32 of numbers and data."""
    crc = 0
    for value in values:
        crc = zlib.crc32(value if isinstance(value, bytes) else b"%d " % value, crc)
    return crc


def _take(due: Iterable[_Due], max_bytes: int) -> list[_Due]:
    """Return the first items of about max_bytes together, at least one."""
    chosen: list[_Due] = []
    spent = 0
    for item in due:
        spent += item.size_bytes
        if chosen and spent > max_bytes:
            break
        chosen.append(item)
    return chosen


def _to_batch(purpose: Purpose, rows: list[tuple[Any, ...]]) -> SpoolBatch | None:
    if not rows:
        return None
    keys, enqueue_counts, sums, counts, blobs = zip(*rows, strict=True)
    batch = VoxelBatch(
        np.array(keys, np.int64), np.array(sums, np.uint64), np.array(counts, np.uint32), from_records(b"".join(blobs))
    )
    return SpoolBatch(purpose, batch, np.array(enqueue_counts, np.int64))
