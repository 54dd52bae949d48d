"""The store of voxel updates: (agent, voxel) → the agent's latest update of that voxel.

An update replaces the agent's earlier update of the voxel if its sequence number is higher, and otherwise it is STALE.
Between equal numbers the larger content wins. So duplicates, resends and reordering change nothing, and removing an
agent leaves no trace. An update without Gaussians is a tombstone. It is kept, because an older update of the voxel may
still arrive.
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import GaussLiteError, SessionUnknownError, StorageError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.epochs import RECORD as EPOCH
from gausslite.fusion.epochs import agent_of
from gausslite.fusion.limits import MissionConfig, SessionRecord
from gausslite.fusion.packed_table import keys_of
from gausslite.fusion.score_index import AgentTotals, Scores, VoxelScoreTable
from gausslite.fusion.update_log import (
    LogChange,
    PutOutcome,
    SlotsOf,
    UpdateLog,
    UpdateRow,
    batch_of,
    data_checksum,
    is_intact,
    require_storable,
)

Execute = Callable[[str, tuple[Any, ...]], object]
"""Executes a statement, with ? for each value, in the transaction that is open."""
TABLES = """
CREATE TABLE keyframes (
    agent_id TEXT NOT NULL, frame_index BIGINT NOT NULL, version INTEGER NOT NULL, part INTEGER NOT NULL,
    parts INTEGER NOT NULL, checksum BIGINT NOT NULL, data BYTEA NOT NULL,
    PRIMARY KEY (agent_id, frame_index, version, part));
CREATE TABLE records (
    name TEXT NOT NULL, agent_id TEXT NOT NULL, checksum BIGINT NOT NULL, data BYTEA NOT NULL,
    PRIMARY KEY (name, agent_id));
CREATE TABLE properties (name TEXT PRIMARY KEY, value TEXT NOT NULL);
"""
"""Those that SQLite and PostgreSQL have in common; SQLite takes any name of a type."""
_PART_BYTES = 1 << 19
_READ_ATTEMPTS = 20
SLICE_VOXELS = 1024
"""Of a map that leaves: its transaction and its vote delay a message by a few milliseconds."""
# nothing, if a connection was lost after the commit and the work is done again
_INSERT_PART = "INSERT INTO keyframes VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING"
_DELETE_KEYFRAME = "DELETE FROM keyframes WHERE agent_id = ? AND frame_index = ?"
_CURRENT = """
coalesce((SELECT max(version) FROM keyframes AS last
    WHERE last.agent_id = own.agent_id AND last.frame_index = own.frame_index AND last.part = last.parts - 1), 0)
"""
"""The version of a keyframe that has its last part; later ones are being written, earlier ones are being deleted."""
_SELECT_SIZES = f"""
SELECT agent_id, frame_index, sum(length(data)) FROM keyframes AS own WHERE version = {_CURRENT} GROUP BY 1, 2
"""  # noqa: S608 - constants of this file
SELECT_PARTS = f"""
SELECT part, parts, checksum, data, agent_id, frame_index FROM keyframes AS own WHERE version = {_CURRENT}
"""  # noqa: S608
"""PartRows."""
PartRow = tuple[int, int, int, bytes, str, int]
_SAVE_RECORD = """
INSERT INTO records VALUES (?, ?, ?, ?)
ON CONFLICT (name, agent_id) DO UPDATE SET checksum = excluded.checksum, data = excluded.data
"""
_DELETE_RECORD = "DELETE FROM records WHERE name = ? AND agent_id = ?"
_SELECT_RECORDS = "SELECT agent_id, data, checksum FROM records WHERE name = ?"
# no agent can have an empty id
_MISSION_CONFIG, _SESSION = ("", "mission-config"), "session"


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

    def __init__(self, slots_of: SlotsOf = np.zeros_like) -> None:
        # the first is held while a change of the log is planned, written and applied; the second for a moment
        self._log_lock, self._index_lock = Lock(), Lock()
        self._log = UpdateLog(slots_of)
        self.incarnation_id = ""

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message in one transaction. Raises InvalidInputError, StorageError."""
        return self.put_all([EncodedSubset.exact(subset)])[0]

    def put_all(self, updates: Sequence[EncodedSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction. Raises InvalidInputError, StorageError."""
        for update in updates:
            require_storable(update)
        with self._log_lock:
            change = self._log.plan(updates, self._read_rows)
            if change.rows:
                self._write(partial(self._write_change, change))
                with self._index_lock:
                    self._log.apply(change)
        return change.outcomes

    def begin_map(self, agent_id: str, moved: Sequence[str] = (), dropped: Sequence[str] = ()) -> str:
        """Begin another map of an agent, in constant time; returns the name that its present one has from then on.

        moved, dropped: names of the records that stay with the former map, if it has updates, and of those to delete.
        At the agent's home this begins an epoch; another server of the store follows.
        """
        with self._log_lock:
            epochs, epoch = self._log.epochs, int(self.find_record(agent_id, EPOCH) or 0)
            former = epochs.former_name(agent_id)
            if self._is_home(agent_id):
                epoch += 1
                kept = moved if agent_id in self.agents() else ()
                rows = [_record(former, name, self.find_record(agent_id, name)) for name in kept]

                def begin(execute: Execute) -> None:
                    for row in (_record(agent_id, EPOCH, str(epoch).encode()), *(row for row in rows if row[-1])):
                        execute(_SAVE_RECORD, row)
                    for name in (*moved, *dropped):
                        execute(_DELETE_RECORD, (name, agent_id))

                self._write(begin)
            with self._index_lock:
                epochs.set(agent_id, epoch)
                self._log.index.rename(agent_id, former)
            return former

    def remove_slice(self, name: str) -> Int64[ndarray, " v"]:
        """Delete some tiles of a map, about SLICE_VOXELS; returns the keys of their voxels, ascending."""
        with self._log_lock:
            with self._index_lock:
                place, numbers = self._log.removable(name, SLICE_VOXELS)
            if numbers:
                self._write(lambda execute: self._delete_rows(execute, numbers))
            with self._index_lock:
                return self._log.remove(name, place)

    def remove_agent(self, name: str) -> Int64[ndarray, " v"]:
        """Delete a map's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        removed = [self.remove_slice(name)]
        while len(removed[-1]):
            removed.append(self.remove_slice(name))
        if self._is_home(name):
            label = self._log.epochs.label_of(name)

            def delete(execute: Execute) -> None:
                execute("DELETE FROM keyframes WHERE agent_id = ?", (label,))
                execute("DELETE FROM records WHERE agent_id = ? AND name != ?", (name, EPOCH))

            self._write(delete)
        return np.sort(np.concatenate(removed))

    def end_epochs(self, agent_id: str) -> None:
        """Count the epochs of an agent without any data from the beginning, unless other servers may have some."""
        if not self.is_shared:
            with self._log_lock:
                self.remove_record(agent_id, EPOCH)
                self._log.epochs.set(agent_id, 0)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._log.index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._index_lock:
            return self._log.index.totals(agent_id)

    def memory_bytes(self, agent_id: str, added: Int64[ndarray, " k"]) -> int:
        """Return the memory that all maps of an agent take, with updates of these voxels, at most."""
        with self._index_lock:
            own = [name for name in self._log.index.agents if agent_of(name) == agent_id]
            return self._log.index.memory_bytes(own, agent_id, added)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._index_lock:
            return self._log.index.digests(agent_id)

    def keys(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Return the keys of an agent's updates (with tombstones), ascending."""
        with self._index_lock:
            places = self._log.index.places(agent_id)
        return np.sort(keys_of(places))

    def scores_of(self, agent_id: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the agent's totals on these voxels, in their order."""
        with self._index_lock:
            return self._log.index.scores_of(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._index_lock:
            return self._log.index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        return self._batches(keys, (agent_id,))[agent_id]

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        return self._batches(keys)

    def _batches(self, keys: Int64[ndarray, " k"] | None, agents: Sequence[str] | None = None) -> dict[str, VoxelBatch]:
        for _ in range(_READ_ATTEMPTS):
            with self._index_lock:
                names = self._log.index.agents if agents is None else agents
                places = {agent_id: self._log.places(agent_id, keys) for agent_id in names}
            numbers = np.unique(np.concatenate([np.zeros(0, np.int64), *(rows for _, rows in places.values())]))
            data = self._read_rows(numbers.tolist()) if len(numbers) else {}
            # rows may have been moved after the index was asked
            if len(data) == len(numbers):
                return {agent_id: batch_of(keys, rows, data) for agent_id, (keys, rows) in places.items()}
        raise StorageError(f"store: expected rows that the index names, got {len(data)} of {len(numbers)}; try again")

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        data = self.find_record(*_MISSION_CONFIG)
        return MissionConfig(*json.loads(data)) if data else None

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        self.save_record(*_MISSION_CONFIG, json.dumps(astuple(mission_config)).encode())

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return the open sessions of the agents whose home is here, sorted by session id."""
        ids = sorted((data.decode(), agent_id) for agent_id, data in self.records(_SESSION).items())
        return tuple(SessionRecord(*own) for own in ids if self._is_home(own[1]))

    def find_session(self, session_id: str) -> SessionRecord | None:
        """Return the open session of this id, whichever server has opened it."""
        rows = self._read(f"{_SELECT_RECORDS} AND data = ?", (_SESSION, session_id.encode()))
        return next((SessionRecord(session_id, agent_id) for agent_id in self._intact(_SESSION, rows)), None)

    def require_session(self, session_id: str) -> None:
        """Raise SessionUnknownError unless the session is open, so that nothing is stored of an agent that is gone."""
        if self.find_session(session_id) is None:
            raise SessionUnknownError("session: has ended; join again")

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        self.save_record(session.agent_id, _SESSION, session.session_id.encode())

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        query = "DELETE FROM records WHERE name = ? AND data = ?"
        self._write(lambda execute: execute(query, (_SESSION, session_id.encode())))

    def save_keyframe(self, agent_id: str, index: int, data: bytes, session_id: str | None = None) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index. One thread for each keyframe.

        A large one takes several transactions, so that others need not wait for all of it. It exists, in place of the
        earlier one, after the last part. If one fails, or the session, if one is given, ends before it, the parts are
        deleted. Raises SessionUnknownError, StorageError.
        """
        parts = [data[start : start + _PART_BYTES] for start in range(0, max(len(data), 1), _PART_BYTES)]
        key = self._log.epochs.label_of(agent_id), index
        before = self._read("SELECT version, part FROM keyframes WHERE agent_id = ? AND frame_index = ?", key)
        version = 1 + max((own for own, _ in before), default=0)

        def delete(part: int, execute: Execute) -> None:
            execute(f"{_DELETE_KEYFRAME} AND version < ? AND part = ?", (*key, version, part))

        def insert(part: int, execute: Execute) -> None:
            if part + 1 == len(parts):
                delete(0, execute)
            checksum = _part_checksum(*key, part, len(parts), parts[part])
            execute(_INSERT_PART, (*key, version, part, len(parts), checksum, parts[part]))

        try:
            self._write_slowly([partial(insert, part) for part in range(len(parts))], session_id)
        except GaussLiteError:
            # else they would take the space of other messages
            with suppress(GaussLiteError):
                self._write(lambda execute: execute(f"{_DELETE_KEYFRAME} AND version = ?", (*key, version)))
            raise
        with suppress(GaussLiteError):
            # else the next start deletes them
            self._write_slowly([partial(delete, part) for part in sorted({part for _, part in before} - {0})])

    def _write_slowly(self, steps: Sequence[Callable[[Execute], None]], session_id: str | None = None) -> None:
        """Do each step in a transaction of its own while the session is open, with pauses for others."""
        for number, step in enumerate(steps):
            if session_id is not None:
                self.require_session(session_id)
            begin_s = time.monotonic()
            self._write(step)
            if number + 1 < len(steps):
                # the lock is not fair: who waits for it must come first
                time.sleep(time.monotonic() - begin_s)

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        label = self._log.epochs.label_of(agent_id)

        def delete(execute: Execute) -> None:
            for index in indices:
                execute(_DELETE_KEYFRAME, (label, index))

        self._write(delete)

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = {}
        for label, index, size in self._read(_SELECT_SIZES):
            sizes.setdefault(self._log.epochs.name_of(label), {})[index] = int(size)
        return sizes

    def remove_unfinished_keyframes(self) -> None:
        """Delete what a killed server was writing or deleting of keyframes, of agents whose home is here."""
        rows = self._read(f"SELECT DISTINCT agent_id FROM keyframes AS own WHERE version != {_CURRENT}")  # noqa: S608
        names = [name for (name,) in rows if self._is_home(name)]
        delete = f"DELETE FROM keyframes AS own WHERE agent_id = ? AND version != {_CURRENT}"  # noqa: S608
        if names:
            self._write(lambda execute: [execute(delete, (name,)) for name in names])

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist. Raises StorageError for a damaged one."""
        query = f"{SELECT_PARTS} AND agent_id = ? AND frame_index = ? ORDER BY part"
        data = join_parts(self._read(query, (self._log.epochs.label_of(agent_id), index)))
        if data is None:
            raise self._damaged(f"keyframe {index} of agent {agent_id!r}")
        return data

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        self._write(lambda execute: execute(_SAVE_RECORD, _record(agent_id, name, data)))

    def remove_record(self, agent_id: str, name: str) -> None:
        """Delete a named record of an agent, if it exists."""
        self._write(lambda execute: execute(_DELETE_RECORD, (name, agent_id)))

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one. Raises StorageError for a damaged one."""
        return self._intact(name, self._read(_SELECT_RECORDS, (name,)))

    def find_record(self, agent_id: str, name: str) -> bytes:
        """Return a named record of an agent; empty if it does not exist. Raises StorageError for a damaged one."""
        rows = self._read(f"{_SELECT_RECORDS} AND agent_id = ?", (name, agent_id))
        return self._intact(name, rows).get(agent_id, b"")

    def _intact(self, name: str, rows: Iterable[tuple[Any, ...]]) -> dict[str, bytes]:
        """Return the record of each agent. Raises StorageError for a damaged row."""
        found = {}
        for agent_id, data, checksum in rows:
            if data_checksum(agent_id, name, data) != checksum:
                raise self._damaged(f"record {name!r} of agent {agent_id!r}")
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

    def _require_intact(self, rows: Iterable[UpdateRow]) -> Iterator[UpdateRow]:
        """Yield the rows. Raises StorageError for a damaged one."""
        for row in rows:
            if not is_intact(row):
                raise self._damaged(f"row {row[0]} of agent {row[1]!r}")
            yield row

    @abstractmethod
    def _write_change(self, change: LogChange, execute: Execute) -> None:
        """Delete and insert rows of updates."""

    @abstractmethod
    def _delete_rows(self, execute: Execute, numbers: Iterable[int]) -> None:
        """Delete rows of updates."""

    @abstractmethod
    def _damaged(self, what: str) -> StorageError:
        """Return the error of damaged content."""


def _record(agent_id: str, name: str, data: bytes) -> tuple[str, str, int, bytes]:
    return name, agent_id, data_checksum(agent_id, name, data), data


def join_parts(rows: Sequence[PartRow]) -> bytes | None:
    """Return a keyframe of its rows, ordered by part; None for a damaged one."""
    for number, (part, parts, checksum, data, agent_id, index) in enumerate(rows):
        if (part, parts) != (number, len(rows)) or _part_checksum(agent_id, index, part, parts, data) != checksum:
            return None
    return b"".join(row[3] for row in rows)


def _part_checksum(agent_id: str, index: int, part: int, parts: int, data: bytes) -> int:
    return data_checksum(agent_id, f"{index}/{part}/{parts}", data)
