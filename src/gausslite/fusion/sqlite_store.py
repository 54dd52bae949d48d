"""The store of voxel updates in one SQLite file: acknowledged updates survive a power failure."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.stored_voxels import to_stored
from gausslite.domain.errors import StorageError
from gausslite.domain.tile_digests import TileDigests
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxel_operations import empty_batch
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.score_index import ScoreIndex, newer_voxels, scores_of
from gausslite.fusion.sqlite_file import (
    PAGE_BYTES,
    RESTORE_ADVICE,
    StoreLock,
    connect,
    open_or_create,
    storage_errors,
)
from gausslite.fusion.store import require_storable
from gausslite.fusion.store_rows import UpdateRow, batch_of_rows, data_checksum, index_rows, is_intact, update_rows
from gausslite.fusion.store_values import AgentTotals, PutOutcome, SessionRecord, StoredScores, VoxelScoreTable

_LOADED_ROWS = 10_000
_UPSERT = """
INSERT INTO voxel_updates VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT (agent_id, voxel) DO UPDATE SET
    update_seq = excluded.update_seq, kappa_sum = excluded.kappa_sum, count = excluded.count,
    checksum = excluded.checksum, gaussians = excluded.gaussians
"""
SELECT_UPDATES = "SELECT agent_id, voxel, update_seq, kappa_sum, count, checksum, gaussians FROM voxel_updates"
"""UpdateRows."""
_SELECT_AGENT = f"{SELECT_UPDATES} WHERE agent_id = ? ORDER BY voxel"
_SELECT_VOXELS = f"{SELECT_UPDATES} WHERE agent_id = ? AND voxel IN (SELECT value FROM json_each(?)) ORDER BY voxel"  # noqa: S608


class SqliteStore:
    """A FusionStore in a file: write-ahead log, synchronous=FULL, one transaction per call, one server at a time.

    The totals of all updates are in memory (ScoreIndex). Reads use a second connection and so do not wait for a commit.
    max_bytes limits the file size; a put beyond it raises StorageError and changes nothing. The constructor reads and
    checks every row. It raises StorageError if the file cannot be opened, is in use by another server, is damaged, or
    has another schema.
    """

    def __init__(self, path: Path, max_bytes: int | None = None) -> None:
        self._path = path
        self._write_lock, self._read_lock, self._index_lock = RLock(), RLock(), RLock()
        self._index = ScoreIndex()
        with ExitStack() as opened:
            lock = StoreLock(path)
            opened.callback(lock.release)
            self._writer = open_or_create(path)
            opened.callback(self._writer.close)
            self._reader = connect(path)
            opened.callback(self._reader.close)
            if max_bytes is not None:
                self._writer.execute(f"PRAGMA max_page_count = {max(1, max_bytes // PAGE_BYTES)}")
            self._load()
            self._incarnation_id = str(self._read("SELECT value FROM properties WHERE name = 'incarnation_id'")[0][0])
            self._grid = _grid_of(self.mission_config())
            self._opened = opened.pop_all()

    @property
    def incarnation_id(self) -> str:
        """The id made with the file, by a restore or by a repair."""
        return self._incarnation_id

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message in one transaction. Raises InvalidInputError, StorageError."""
        return self.put_all([subset])[0]

    def put_all(self, subsets: Sequence[RoiSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction. Raises InvalidInputError, StorageError."""
        for subset in subsets:
            require_storable(subset)
        encoded = [to_stored(subset.batch, self._grid) for subset in subsets]
        with self._write_lock:
            masks = [newer_voxels(self._index, subset, self.batch) for subset in subsets]
            if any(mask.any() for mask in masks):
                with self._transaction() as db:
                    for subset, own, mask in zip(subsets, encoded, masks, strict=True):
                        db.executemany(_UPSERT, update_rows(subset, own, mask))
            with self._index_lock:
                for subset, mask in zip(subsets, masks, strict=True):
                    self._index.put(subset.agent_id, subset.batch.keys[mask], scores_of(subset, mask))
        return [
            PutOutcome(subset.batch.keys[mask], subset.batch.keys[~mask])
            for subset, mask in zip(subsets, masks, strict=True)
        ]

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        with self._write_lock:
            with self._transaction() as db:
                for table in ("voxel_updates", "keyframes", "records"):
                    db.execute(f"DELETE FROM {table} WHERE agent_id = ?", (agent_id,))  # noqa: S608 - the names are constants
            with self._index_lock:
                return self._index.remove_agent(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._index_lock:
            return self._index.totals(agent_id)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._index_lock:
            return self._index.digests(agent_id)

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        with self._index_lock:
            return self._index.stored(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._index_lock:
            return self._index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        rows: list[UpdateRow] = (
            self._read(_SELECT_AGENT, (agent_id,))
            if keys is None
            else self._read(_SELECT_VOXELS, (agent_id, _as_json(keys)))
        )
        for row in rows:
            self._require_intact(row)
        return batch_of_rows(rows)

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        scores = None if keys is None else self.scores(keys)
        with self._read_lock, storage_errors(self._path):
            # a read transaction: all queries see the same commit
            self._reader.execute("BEGIN")
            try:
                if scores is None:
                    return {agent_id: self.batch(agent_id) for agent_id in self.agents()}
                present = set(np.unique(scores.agent_index).tolist())
                return {
                    agent_id: self.batch(agent_id, keys) if index in present else empty_batch()
                    for index, agent_id in enumerate(scores.agents)
                }
            finally:
                self._reader.execute("COMMIT")

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        rows = self._read("SELECT mission_id, world_frame, voxel_size_m FROM mission_config")
        return MissionConfig(*rows[0]) if rows else None

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        values = mission_config.mission_id, mission_config.world_frame, mission_config.voxel_size_m
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO mission_config VALUES (1, ?, ?, ?)", values)
        self._grid = _grid_of(mission_config)

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
        row = agent_id, index, data_checksum(agent_id, index, data), data
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO keyframes VALUES (?, ?, ?, ?)", row)

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
        """Return an encoded keyframe; empty if it does not exist. Raises StorageError for a damaged one."""
        query = "SELECT data, checksum FROM keyframes WHERE agent_id = ? AND frame_index = ?"
        for data, checksum in self._read(query, (agent_id, index)):
            if data_checksum(agent_id, index, data) != checksum:
                raise self._damaged(f"keyframe {index} of agent {agent_id!r}")
            return bytes(data)
        return b""

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        row = name, agent_id, data_checksum(agent_id, name, data), data
        with self._transaction() as db:
            db.execute("INSERT OR REPLACE INTO records VALUES (?, ?, ?, ?)", row)

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one. Raises StorageError for a damaged one."""
        rows = self._read("SELECT agent_id, data, checksum FROM records WHERE name = ?", (name,))
        for agent_id, data, checksum in rows:
            if data_checksum(agent_id, name, data) != checksum:
                raise self._damaged(f"record {name!r} of agent {agent_id!r}")
        return {agent_id: data for agent_id, data, _ in rows}

    def close(self) -> None:
        """Write the log into the file and close it."""
        with self._write_lock, self._read_lock:
            self._opened.close()

    def _load(self) -> None:
        """Check every row of updates and fill the index."""
        with storage_errors(self._path):
            check = self._reader.execute("PRAGMA quick_check(1)").fetchone()[0]
            if check != "ok":
                raise StorageError(f"store {self._path}: expected an undamaged file, got {check!r}; {RESTORE_ADVICE}")
            cursor = self._reader.execute(f"{SELECT_UPDATES} ORDER BY agent_id, voxel")
            while rows := cursor.fetchmany(_LOADED_ROWS):
                for row in rows:
                    self._require_intact(row)
                index_rows(self._index, rows)

    def _require_intact(self, row: UpdateRow) -> None:
        if not is_intact(row):
            raise self._damaged(f"voxel {row[1]} of agent {row[0]!r}")

    def _damaged(self, what: str) -> StorageError:
        return StorageError(f"store {self._path}: {what} is damaged (its checksum does not match); {RESTORE_ADVICE}")

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        with self._read_lock, storage_errors(self._path):
            return self._reader.execute(query, values).fetchall()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._write_lock, storage_errors(self._path):
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                raise


def _grid_of(mission_config: MissionConfig | None) -> VoxelGrid | None:
    return None if mission_config is None else VoxelGrid(mission_config.voxel_size_m)


def _as_json(keys: Int64[ndarray, " k"]) -> str:
    return json.dumps(keys.tolist())
