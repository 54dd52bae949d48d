"""The store of voxel updates in memory: fast, for one mission, lost when the process ends."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from threading import RLock

from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.store import (
    AgentTotals,
    MissionConfig,
    PutOutcome,
    SessionRecord,
    StoredScores,
    VoxelScoreTable,
    require_storable,
)
from gausslite.fusion.store_rows import UpdateLog, read_batches


class MemoryStore:
    """A FusionStore in dictionaries; 21 bytes per quantised Gaussian (codec.stored_voxels) and about 300 per voxel."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._incarnation_id = secrets.token_hex(16)
        self._log = UpdateLog()
        self._rows: dict[int, bytes] = {}
        self._sessions: dict[str, SessionRecord] = {}
        self._mission_config: MissionConfig | None = None
        self._keyframes: dict[str, dict[int, bytes]] = {}
        self._records: dict[str, dict[str, bytes]] = {}

    @property
    def incarnation_id(self) -> str:
        """A new id with every store in memory."""
        return self._incarnation_id

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message completely, or nothing of it on an error. Raises InvalidInputError."""
        return self.put_all([StoredSubset.exact(subset)])[0]

    def put_all(self, updates: Sequence[StoredSubset]) -> list[PutOutcome]:
        """Store messages of different agents: all, or none on an error. Raises InvalidInputError."""
        for update in updates:
            require_storable(update)
        with self._lock:
            change = self._log.plan(updates, self._read)
            for number in change.deleted:
                del self._rows[number]
            self._rows.update((number, data) for number, _, _, data in change.rows)
            self._log.apply(change)
            return change.outcomes

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        with self._lock:
            self._keyframes.pop(agent_id, None)
            for records in self._records.values():
                records.pop(agent_id, None)
            for number in self._log.rows_of(agent_id):
                del self._rows[number]
            return self._log.remove_agent(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        with self._lock:
            return self._log.index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._lock:
            return self._log.index.totals(agent_id)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._lock:
            return self._log.index.digests(agent_id)

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        with self._lock:
            return self._log.index.stored(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._lock:
            return self._log.index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        with self._lock:
            return read_batches(self._log, self._lock, self._read, keys, (agent_id,))[agent_id]

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        with self._lock:
            return read_batches(self._log, self._lock, self._read, keys)

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        with self._lock:
            return self._mission_config

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        with self._lock:
            self._mission_config = mission_config

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        with self._lock:
            return tuple(sorted(self._sessions.values(), key=lambda session: session.session_id))

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        with self._lock:
            replaced = {s.session_id for s in self._sessions.values() if s.agent_id == session.agent_id}
            for session_id in replaced:
                del self._sessions[session_id]
            self._sessions[session.session_id] = session

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        with self._lock:
            self._sessions.pop(session_id, None)

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        with self._lock:
            self._keyframes.setdefault(agent_id, {})[index] = data

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        with self._lock:
            for index in indices:
                self._keyframes.get(agent_id, {}).pop(index, None)

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        with self._lock:
            return {
                agent_id: {index: len(data) for index, data in frames.items()}
                for agent_id, frames in self._keyframes.items()
                if frames
            }

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist."""
        with self._lock:
            return self._keyframes.get(agent_id, {}).get(index, b"")

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        with self._lock:
            self._records.setdefault(name, {})[agent_id] = data

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one."""
        with self._lock:
            return dict(self._records.get(name, {}))

    def close(self) -> None:
        """Do nothing; there are no files to close."""

    def _read(self, numbers: Sequence[int]) -> dict[int, bytes]:
        return {number: self._rows[number] for number in numbers}
