"""The client of one shard: sends the calls of a store to its primary, and to the next one when that fails."""

from __future__ import annotations

import logging
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from threading import Lock
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Int64
from numpy import ndarray

from gausslite.cluster.journal import JournalEntry, JournalGapError
from gausslite.cluster.own_writes import OwnWrites
from gausslite.cluster.shard_directory import Primary
from gausslite.cluster.store_calls import JOURNAL, LogPosition, StoreCall, StoreReply
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.tile_digests import TileDigests
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store_changes import ContentReplaced, StoreChange, UpdatesStored
from gausslite.fusion.store_values import AgentTotals, PutOutcome, SessionRecord, StoredScores, VoxelScoreTable

_log = logging.getLogger(__name__)
_FAILOVER_LIMIT_S = 60.0
_RETRY_S = 0.05
_MAX_RETRY_S = 1.0


@runtime_checkable
class Directory(Protocol):
    """A ShardDirectory in another process. Both methods raise UnavailableError if it cannot be reached."""

    def primary(self, shard: int) -> Primary:
        """Return the current primary."""
        ...

    def report_failure(self, shard: int, epoch: int) -> Primary:
        """Return the current primary, after a check of this epoch's."""
        ...


CallReplica = Callable[[str, int, StoreCall], StoreReply]
"""Runs a call on the replica of this name in this epoch. Raises UnavailableError if it cannot be reached or does not
lead, and what the store raises."""


class RemoteStore:
    """A FusionStore in the replicas of a shard. Thread-safe.

    A call waits up to 60 s for a primary, and then raises StorageError. A write whose reply was lost is sent again, so
    `put_all` may report as stale what it has stored; ShardedStore computes the outcome itself. `take_changes` returns
    also the own updates, because the reply of one may have been lost.
    """

    def __init__(self, shard: int, directory: Directory, call_replica: CallReplica) -> None:
        """Changes are followed from now on. Raises StorageError."""
        self._shard, self._directory, self._call_replica = shard, directory, call_replica
        self._primary = directory.primary(shard)
        self._position = LogPosition(self._primary.epoch, 0)
        self._origin = secrets.token_hex(8)
        self._own_writes = OwnWrites()
        self._fetching = Lock()
        self._fetched: deque[JournalEntry] = deque()
        self._followed = self._current_transactions()

    @property
    def position(self) -> LogPosition:
        """The position of the shard after the latest acknowledged call."""
        return self._position

    @property
    def incarnation_id(self) -> str:
        """The id of the shard's content."""
        return str(self._call("incarnation_id"))

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message. Raises InvalidInputError, StorageError."""
        return self.put_all([subset])[0]

    def put_all(self, subsets: Sequence[RoiSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction. Raises InvalidInputError, StorageError."""
        outcomes: list[PutOutcome] = self._write("put_all", list(subsets))
        return outcomes

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        keys: Int64[ndarray, " v"] = self._write("remove_agent", agent_id)
        return keys

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        agents: tuple[str, ...] = self._call("agents")
        return agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates; zero for an unknown agent."""
        totals: AgentTotals = self._call("totals", agent_id)
        return totals

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        digests: TileDigests = self._call("digests", agent_id)
        return digests

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        scores: StoredScores = self._call("stored", agent_id, keys)
        return scores

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        table: VoxelScoreTable = self._call("scores", keys)
        return table

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        batch: VoxelBatch = self._call("batch", agent_id, keys)
        return batch

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        batches: dict[str, VoxelBatch] = self._call("batches", keys)
        return batches

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        mission_config: MissionConfig | None = self._call("mission_config")
        return mission_config

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        self._write("set_mission_config", mission_config)

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        sessions: tuple[SessionRecord, ...] = self._call("sessions")
        return sessions

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        self._write("save_session", session)

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        self._write("end_session", session_id)

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        self._write("save_keyframe", agent_id, index, data)

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        self._write("remove_keyframes", agent_id, list(indices))

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = self._call("keyframe_sizes")
        return sizes

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist."""
        data: bytes = self._call("keyframe", agent_id, index)
        return data

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        self._write("save_record", agent_id, name, data)

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one."""
        records: dict[str, bytes] = self._call("records", name)
        return records

    def fetch_changes(self) -> bool:
        """Fetch what was written since the last call. Raises StorageError."""
        with self._fetching:
            try:
                while entries := self._call(JOURNAL, self._followed):
                    self._fetched.extend(entries)
                    self._followed = entries[-1].transactions
            except JournalGapError as error:
                _log.warning("shard %d: read again, because changes were missed (%s)", self._shard, error)
                self._followed = self._current_transactions()
                self._fetched.append(JournalEntry(self._followed, "", (ContentReplaced(),)))
            return bool(self._fetched)

    def take_changes(self) -> list[StoreChange]:
        """Return what was fetched: the other servers' writes, and all updates."""
        changes: list[StoreChange] = []
        # no lock: `fetch_changes` may hold it for as long as a failover takes
        while self._fetched:
            entry = self._fetched.popleft()
            if ContentReplaced() in entry.changes:
                self._own_writes.clear()
            is_own = entry.origin == self._origin
            news = (each for each in entry.changes if self._own_writes.is_news(each, is_own))
            changes += [replace(each, is_own=is_own) if isinstance(each, UpdatesStored) else each for each in news]
        return changes

    def close(self) -> None:
        """Do nothing: the replicas go on."""

    def _current_transactions(self) -> int:
        reply = self._run_anywhere(StoreCall("agents"))
        return reply.position.transactions

    def _write(self, method: str, *arguments: Any) -> Any:
        call = StoreCall(method, arguments, self._origin)
        with self._own_writes.writing(call):
            return self._run(call)

    def _call(self, method: str, *arguments: Any) -> Any:
        return self._run(StoreCall(method, arguments, self._origin))

    def _run(self, call: StoreCall) -> Any:
        return self._run_anywhere(call).result

    def _run_anywhere(self, call: StoreCall) -> StoreReply:
        limit_s, wait_s = time.monotonic() + _FAILOVER_LIMIT_S, _RETRY_S
        while True:
            primary = self._primary
            try:
                reply = self._call_replica(primary.name, primary.epoch, call)
            except UnavailableError as error:
                if time.monotonic() > limit_s:
                    raise StorageError(f"shard {self._shard}: no primary within {_FAILOVER_LIMIT_S:g} s") from error
                time.sleep(wait_s)
                wait_s = min(2 * wait_s, _MAX_RETRY_S)
                self._find_primary(primary)
            else:
                self._position = reply.position
                return reply

    def _find_primary(self, failed: Primary) -> None:
        try:
            self._primary = self._directory.report_failure(self._shard, failed.epoch)
        except (UnavailableError, StorageError):
            # the next attempt asks again, until the limit
            return
