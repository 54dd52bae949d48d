"""The store of voxel updates: (agent, voxel) → the agent's latest update of that voxel.

An update replaces the agent's earlier update of the voxel if its sequence number is higher, and otherwise it is STALE.
Between equal numbers the larger content wins. So duplicates, resends and reordering change nothing, and removing an
agent leaves no trace. An update without Gaussians is a tombstone. It is kept, because an older update of the voxel may
still arrive.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.errors import StorageError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.store_rows import LogChange, SlotsOf, UpdateLog, data_checksum, read_batches
from gausslite.fusion.store_values import (
    AgentTotals,
    MissionConfig,
    PutOutcome,
    Scores,
    SessionRecord,
    VoxelScoreTable,
    require_storable,
)

Execute = Callable[[str, tuple[Any, ...]], object]
"""Executes a statement, with ? for each value, in the transaction that is open."""
_PART_BYTES = 1 << 19
_DELETE_KEYFRAME = "DELETE FROM keyframes WHERE agent_id = ? AND frame_index = ?"
_SELECT_SIZES = """
SELECT agent_id, frame_index, sum(length(data)) FROM keyframes GROUP BY agent_id, frame_index
HAVING count(*) = max(parts)
"""


class FusionStore(ABC):
    """Owns the voxel updates, the mission's configuration and the sessions. Thread-safe. Its rows are in a database.

    incarnation_id changes when the content may be older than what was acknowledged: with a new store, after a restore
    and after a repair. Then the agents compare digests and send what is missing. The totals of all updates are in
    memory (ScoreIndex).

    When a method of a durable store has returned, its effect survives a crash. All methods raise StorageError if the
    storage refuses; the store stays usable for other calls. Statements here are those that SQLite and PostgreSQL have
    in common.
    """

    is_shared = False
    """Whether other servers have parts of it."""
    _config_key: str
    """The column of mission_config that has the value 1 in its only row."""

    def __init__(self, slots_of: SlotsOf = np.zeros_like) -> None:
        self._write_lock, self._index_lock = RLock(), RLock()
        self._log = UpdateLog(slots_of)
        self._incarnation_id = ""

    @property
    def incarnation_id(self) -> str:
        """The id of this content; see the class."""
        return self._incarnation_id

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message in one transaction. Raises InvalidInputError, StorageError."""
        return self.put_all([StoredSubset.exact(subset)])[0]

    def put_all(self, updates: Sequence[StoredSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction. Raises InvalidInputError, StorageError."""
        for update in updates:
            require_storable(update)
        with self._write_lock:
            change = self._log.plan(updates, self._read_rows)
            if change.rows:
                self._write_change(change)
                with self._index_lock:
                    self._log.apply(change)
        return change.outcomes

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""

        def delete(execute: Execute) -> None:
            self._delete_rows(execute, self._log.rows_of(agent_id))
            for table in ("keyframes", "records") if self._is_home(agent_id) else ():
                execute(f"DELETE FROM {table} WHERE agent_id = ?", (agent_id,))  # noqa: S608 - constant names

        with self._write_lock:
            self._write(delete)
            with self._index_lock:
                return self._log.remove_agent(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._log.index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._index_lock:
            return self._log.index.totals(agent_id)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._index_lock:
            return self._log.index.digests(agent_id)

    def keys(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Return the keys of an agent's updates (with tombstones), ascending."""
        with self._index_lock:
            return np.ascontiguousarray(self._log.index.sorted_scores(agent_id)["keys"])

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the agent's totals on these voxels, in their order."""
        with self._index_lock:
            return self._log.index.stored(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._index_lock:
            return self._log.index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        return read_batches(self._log, self._index_lock, self._read_rows, keys, (agent_id,))[agent_id]

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        return read_batches(self._log, self._index_lock, self._read_rows, keys)

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        rows = self._read("SELECT mission_id, world_frame, voxel_size_m FROM mission_config")
        return MissionConfig(*rows[0]) if rows else None

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        values = mission_config.mission_id, mission_config.world_frame, mission_config.voxel_size_m
        columns = "mission_id", "world_frame", "voxel_size_m"
        self._write_row("mission_config", (self._config_key,), columns, (1, *values))

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return the open sessions of the agents whose home is here, sorted by session id."""
        rows = self._read("SELECT session_id, agent_id FROM sessions")
        return tuple(SessionRecord(*row) for row in sorted(rows) if self._is_home(row[1]))

    def find_session(self, session_id: str) -> SessionRecord | None:
        """Return the open session of this id, whichever server has opened it."""
        query = "SELECT session_id, agent_id FROM sessions WHERE session_id = ?"
        return next((SessionRecord(*row) for row in self._read(query, (session_id,))), None)

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        self._write_row("sessions", ("agent_id",), ("session_id",), (session.agent_id, session.session_id))

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        self._write(lambda execute: execute("DELETE FROM sessions WHERE session_id = ?", (session_id,)))

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index. One thread for each keyframe.

        A large one takes several transactions, so that others need not wait for all of it, and exists after the last.
        """
        parts = [data[start : start + _PART_BYTES] for start in range(0, max(len(data), 1), _PART_BYTES)]
        for part, content in enumerate(parts):
            row = agent_id, index, part, len(parts), data_checksum(agent_id, index, content), content
            begin_s = time.monotonic()
            self._write(partial(_insert_part, row))
            if part + 1 < len(parts):
                # the lock is not fair: who waits for it must come first
                time.sleep(time.monotonic() - begin_s)

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""

        def delete(execute: Execute) -> None:
            for index in indices:
                execute(_DELETE_KEYFRAME, (agent_id, index))

        self._write(delete)

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = {}
        for agent_id, index, size in self._read(_SELECT_SIZES):
            sizes.setdefault(agent_id, {})[index] = int(size)
        return sizes

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist. Raises StorageError for a damaged one."""
        query = "SELECT parts, data, checksum FROM keyframes WHERE agent_id = ? AND frame_index = ? ORDER BY part"
        rows = self._read(query, (agent_id, index))
        found = [self._intact(index, [(agent_id, *row)])[agent_id] for _, *row in rows]
        return b"".join(found) if all(parts == len(found) for parts, *_ in rows) else b""

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        row = name, agent_id, data_checksum(agent_id, name, data), data
        self._write_row("records", ("name", "agent_id"), ("checksum", "data"), row)

    def remove_record(self, agent_id: str, name: str) -> None:
        """Delete a named record of an agent, if it exists."""
        self._write(lambda execute: execute("DELETE FROM records WHERE name = ? AND agent_id = ?", (name, agent_id)))

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one. Raises StorageError for a damaged one."""
        return self._intact(name, self._read("SELECT agent_id, data, checksum FROM records WHERE name = ?", (name,)))

    def find_record(self, agent_id: str, name: str) -> bytes:
        """Return a named record of an agent; empty if it does not exist. Raises StorageError for a damaged one."""
        query = "SELECT agent_id, data, checksum FROM records WHERE name = ? AND agent_id = ?"
        return self._intact(name, self._read(query, (name, agent_id))).get(agent_id, b"")

    def _intact(self, name: str | int, rows: Iterable[tuple[str, bytes, int]]) -> dict[str, bytes]:
        """Return the data of each agent. Raises StorageError for a damaged row."""
        found = {}
        for agent_id, data, checksum in rows:
            if data_checksum(agent_id, name, data) != checksum:
                kind = f"record {name!r}" if isinstance(name, str) else f"keyframe {name}"
                raise self._damaged(f"{kind} of agent {agent_id!r}")
            found[agent_id] = bytes(data)
        return found

    @abstractmethod
    def close(self) -> None:
        """Close the connections; no other method may be called afterwards."""

    def _is_home(self, agent_id: str) -> bool:  # noqa: ARG002 - a store of one server has all
        """Return whether this store has what is known of the agent beside its voxels."""
        return True

    @abstractmethod
    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """Return the rows of a query, with ? for each value. Raises StorageError."""

    @abstractmethod
    def _write(self, work: Callable[[Execute], object]) -> None:
        """Do the work in one transaction. Raises StorageError."""

    @abstractmethod
    def _read_rows(self, numbers: Sequence[int]) -> dict[int, bytes]:
        """Return the voxels of those of these rows that exist. Raises StorageError, also for damaged ones."""

    @abstractmethod
    def _write_change(self, change: LogChange) -> None:
        """Delete and insert rows of updates in one transaction. Raises StorageError."""

    @abstractmethod
    def _delete_rows(self, execute: Execute, numbers: Iterable[int]) -> None:
        """Delete rows of updates."""

    @abstractmethod
    def _damaged(self, what: str) -> StorageError:
        """Return the error of damaged content."""

    def _write_row(self, table: str, key: Sequence[str], columns: Sequence[str], row: tuple[Any, ...]) -> None:
        """Insert a row, or replace the columns of the one with its key."""
        self._write(lambda execute: execute(_upsert(table, key, columns), row))


def _insert_part(row: tuple[str, int, int, int, int, bytes], execute: Execute) -> None:
    """Insert a part of a keyframe; the first one deletes the earlier keyframe of its frame index."""
    if row[2] == 0:
        execute(_DELETE_KEYFRAME, row[:2])
    execute(_upsert("keyframes", ("agent_id", "frame_index", "part"), ("parts", "checksum", "data")), row)


def _upsert(table: str, key: Sequence[str], columns: Sequence[str]) -> str:
    """Return the statement that inserts a row of a key and its columns, or replaces the columns."""
    names, places = ", ".join((*key, *columns)), ", ".join(["?"] * (len(key) + len(columns)))
    newer = ", ".join(f"{name} = excluded.{name}" for name in columns)
    return (
        f"INSERT INTO {table} ({names}) VALUES ({places}) "  # noqa: S608 - the names are constants
        f"ON CONFLICT ({', '.join(key)}) DO UPDATE SET {newer}"
    )
