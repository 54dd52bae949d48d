"""The store of voxel updates in one SQLite file: acknowledged updates survive a power failure."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.records import from_bytes, to_records
from gausslite.domain.errors import StorageError
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store import PutOutcome, SessionRecord, VoxelScoreTable, require_storable

SCHEMA_VERSION = 4
_APPLICATION_ID = 0x47534C54  # "GSLT", to recognise other programs' databases
_PAGE_BYTES = 4096
_SCHEMA = """
CREATE TABLE voxel_updates (
    agent_id TEXT NOT NULL, voxel INTEGER NOT NULL, update_seq INTEGER NOT NULL,
    kappa_sum INTEGER NOT NULL, count INTEGER NOT NULL, records BLOB NOT NULL,
    PRIMARY KEY (agent_id, voxel));
CREATE TABLE sessions (session_id TEXT PRIMARY KEY, agent_id TEXT NOT NULL UNIQUE);
CREATE TABLE keyframes (
    agent_id TEXT NOT NULL, frame_index INTEGER NOT NULL, data BLOB NOT NULL, PRIMARY KEY (agent_id, frame_index));
CREATE TABLE records (name TEXT NOT NULL, agent_id TEXT NOT NULL, data BLOB NOT NULL, PRIMARY KEY (name, agent_id));
CREATE TABLE mission_config (
    only INTEGER PRIMARY KEY CHECK (only = 1),
    mission_id TEXT NOT NULL, world_frame TEXT NOT NULL, voxel_size_m REAL NOT NULL);
"""
_WITH_KEYS = " AND voxel IN (SELECT value FROM json_each(?))"
_UPSERT = "INSERT OR REPLACE INTO voxel_updates VALUES (?, ?, ?, ?, ?, ?)"


class SqliteStore:
    """A FusionStore in a file: write-ahead log, synchronous=FULL, one transaction per message, one server at a time.

    max_bytes limits the file size; a put beyond it raises StorageError and changes nothing. The constructor raises
    StorageError if the file cannot be opened, is in use by another server, is damaged, or has another schema.
    """

    def __init__(self, path: Path, max_bytes: int | None = None) -> None:
        self._path = path
        self._lock = RLock()
        self._db = _connect(path)
        try:
            with self._storage_errors():
                self._prepare(max_bytes)
        except BaseException:
            self._db.close()
            raise

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message in one transaction. Raises InvalidInputError, StorageError."""
        require_storable(subset)
        batch, offsets = subset.batch, subset.batch.offsets
        records = to_records(batch.gaussians)
        with self._transaction() as db:
            query = "SELECT voxel, update_seq FROM voxel_updates WHERE agent_id = ?"
            stored = dict(db.execute(query + _WITH_KEYS, (subset.agent_id, _keys_as_json(batch.keys))))
            accepted = np.array([stored.get(key, -1) < subset.update_seq for key in batch.keys.tolist()], np.bool_)
            rows = (
                (
                    subset.agent_id,
                    int(batch.keys[i]),
                    subset.update_seq,
                    int(batch.kappa_sums[i]),
                    int(batch.counts[i]),
                    records[offsets[i] : offsets[i + 1]].tobytes(),
                )
                for i in np.flatnonzero(accepted)
            )
            db.executemany(_UPSERT, rows)
        return PutOutcome(batch.keys[accepted], batch.keys[~accepted])

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        with self._transaction() as db:
            rows = db.execute(
                "SELECT voxel FROM voxel_updates WHERE agent_id = ? ORDER BY voxel", (agent_id,)
            ).fetchall()
            for table in ("voxel_updates", "keyframes", "records"):
                db.execute(f"DELETE FROM {table} WHERE agent_id = ?", (agent_id,))  # noqa: S608 - the names are constants
        return np.array([voxel for (voxel,) in rows], np.int64)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        rows = self._read("SELECT DISTINCT agent_id FROM voxel_updates")
        # not sorted by SQL, because the order must be the same in every store
        return tuple(sorted(agent_id for (agent_id,) in rows))

    def highest_update_seq(self, agent_id: str) -> int:
        """Return the highest sequence number among an agent's updates; 0 without any."""
        rows = self._read("SELECT COALESCE(MAX(update_seq), 0) FROM voxel_updates WHERE agent_id = ?", (agent_id,))
        return int(rows[0][0])

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._lock:
            agents = self.agents()
            parts = [self._select("voxel, update_seq, kappa_sum, count", agent_id, keys) for agent_id in agents]
        rows = [row for part in parts for row in part]
        return VoxelScoreTable(
            agents,
            np.repeat(np.arange(len(agents), dtype=np.int32), [len(part) for part in parts]),
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.int64),
            np.array([row[2] for row in rows], np.uint64),
            np.array([row[3] for row in rows], np.uint32),
        )

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        rows = self._select("voxel, kappa_sum, count, records", agent_id, keys)
        return VoxelBatch(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.uint64),
            np.array([row[2] for row in rows], np.uint32),
            from_bytes(b"".join(row[3] for row in rows)),
        )

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        with self._lock:
            return {agent_id: self.batch(agent_id, keys) for agent_id in self.agents()}

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        rows = self._read("SELECT mission_id, world_frame, voxel_size_m FROM mission_config")
        return MissionConfig(*rows[0]) if rows else None

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        with self._transaction() as db:
            db.execute(
                "INSERT OR REPLACE INTO mission_config VALUES (1, ?, ?, ?)",
                (mission_config.mission_id, mission_config.world_frame, mission_config.voxel_size_m),
            )

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        rows = self._read("SELECT session_id, agent_id FROM sessions")
        return tuple(sorted((SessionRecord(*row) for row in rows), key=lambda session: session.session_id))

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO sessions VALUES (?, ?)", (session.session_id, session.agent_id))

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        with self._transaction() as db:
            db.execute("DELETE FROM sessions WHERE session_id = ?", (session_id,))

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?)", (agent_id, index, data))

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        with self._transaction() as db:
            rows = ((agent_id, index) for index in indices)
            db.executemany("DELETE FROM keyframes WHERE agent_id = ? AND frame_index = ?", rows)

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = {}
        for agent_id, index, size in self._read("SELECT agent_id, frame_index, length(data) FROM keyframes"):
            sizes.setdefault(agent_id, {})[index] = size
        return sizes

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist."""
        query = "SELECT data FROM keyframes WHERE agent_id = ? AND frame_index = ?"
        rows = self._read(query, (agent_id, index))
        return bytes(rows[0][0]) if rows else b""

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?)", (name, agent_id, data))

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one."""
        return dict(self._read("SELECT agent_id, data FROM records WHERE name = ?", (name,)))

    def close(self) -> None:
        """Write the log into the file and close it."""
        with self._lock:
            self._db.close()

    def _prepare(self, max_bytes: int | None) -> None:
        db = self._db
        # exclusive: a second server on this file would not see the changes of the first
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        is_store = db.execute("PRAGMA application_id").fetchone()[0] == _APPLICATION_ID
        is_new = db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0] == 0
        version = db.execute("PRAGMA user_version").fetchone()[0]
        if not is_store and not is_new:
            raise StorageError(f"store {self._path}: expected a GaussLite store, got another program's database")
        if is_store and not is_new and version != SCHEMA_VERSION:
            raise StorageError(f"store {self._path}: expected schema version {SCHEMA_VERSION}, got {version}")
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        if is_new:
            header = f"PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {SCHEMA_VERSION};"
            db.executescript(f"BEGIN IMMEDIATE; {header} {_SCHEMA} COMMIT;")
        check = db.execute("PRAGMA quick_check(1)").fetchone()[0]
        if check != "ok":
            raise StorageError(f"store {self._path}: expected an undamaged file, got: {check}".replace("\n", " "))
        if max_bytes is not None:
            db.execute(f"PRAGMA max_page_count = {max(1, max_bytes // _PAGE_BYTES)}")

    def _select(self, columns: str, agent_id: str, keys: Int64[ndarray, " k"] | None) -> list[tuple[Any, ...]]:
        query, values = f"SELECT {columns} FROM voxel_updates WHERE agent_id = ?", [agent_id]  # noqa: S608 - the names are constants
        if keys is not None:
            query, values = query + _WITH_KEYS, [agent_id, _keys_as_json(keys)]
        return self._read(f"{query} ORDER BY voxel", tuple(values))

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._lock, self._storage_errors():
            return self._db.execute(query, values).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._storage_errors():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    @contextmanager
    def _storage_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StorageError(f"store {self._path}: {_explain(error)}") from error


def _connect(path: Path) -> sqlite3.Connection:
    try:
        return sqlite3.connect(path, timeout=0.5, isolation_level=None, check_same_thread=False)
    except sqlite3.Error as error:
        raise StorageError(f"store {path}: cannot be opened ({error}); expected a file in a writable folder") from error


def _keys_as_json(keys: Int64[ndarray, " k"]) -> str:
    return json.dumps(keys.tolist())


def _explain(error: sqlite3.Error) -> str:
    text = str(error)
    if "not a database" in text or "malformed" in text:
        return f"expected an undamaged GaussLite store, got another kind of file ({text})"
    if "locked" in text:
        return "in use by another server; give each its own file"
    if "full" in text:
        return "no space left (disk full or the store's size limit); nothing of this message was stored"
    return f"refused ({text})"
