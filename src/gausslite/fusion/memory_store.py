"""The store of voxel updates in memory: fast, for one mission, lost when the process ends."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from threading import RLock

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.records import from_bytes, to_records
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store import PutOutcome, SessionRecord, VoxelScoreTable, require_storable


@dataclass(frozen=True, slots=True)
class _VoxelUpdate:
    """An agent's latest update of one voxel; the records are those of codec.records."""

    update_seq: int
    kappa_sum: int
    count: int
    records: bytes


class MemoryStore:
    """A FusionStore in dictionaries; 63 bytes per Gaussian and about 250 per voxel."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._updates: dict[str, dict[int, _VoxelUpdate]] = {}
        self._sessions: dict[str, SessionRecord] = {}
        self._mission_config: MissionConfig | None = None
        self._keyframes: dict[str, dict[int, bytes]] = {}
        self._records: dict[str, dict[str, bytes]] = {}

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message; an update that is not newer than the stored one is stale. Raises InvalidInputError."""
        require_storable(subset)
        batch, offsets = subset.batch, subset.batch.offsets
        records = to_records(batch.gaussians)
        accepted = np.zeros(len(batch), np.bool_)
        with self._lock:
            stored = self._updates.setdefault(subset.agent_id, {})
            for i, key in enumerate(batch.keys.tolist()):
                update = stored.get(key)
                if update is not None and update.update_seq >= subset.update_seq:
                    continue
                # tobytes copies, so that a small update does not keep the whole message in memory
                data = records[offsets[i] : offsets[i + 1]].tobytes()
                stored[key] = _VoxelUpdate(subset.update_seq, int(batch.kappa_sums[i]), int(batch.counts[i]), data)
                accepted[i] = True
            if not stored:
                del self._updates[subset.agent_id]
        return PutOutcome(batch.keys[accepted], batch.keys[~accepted])

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        with self._lock:
            self._keyframes.pop(agent_id, None)
            for records in self._records.values():
                records.pop(agent_id, None)
            return np.array(sorted(self._updates.pop(agent_id, {})), np.int64)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        with self._lock:
            return tuple(sorted(self._updates))

    def highest_update_seq(self, agent_id: str) -> int:
        """Return the highest sequence number among an agent's updates; 0 without any."""
        with self._lock:
            return max((update.update_seq for update in self._updates.get(agent_id, {}).values()), default=0)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._lock:
            agents = self.agents()
            rows = [
                (index, key, update.update_seq, update.kappa_sum, update.count)
                for index, agent_id in enumerate(agents)
                for key, update in self._select(agent_id, keys)
            ]
        columns = list(zip(*rows, strict=True)) or [()] * 5
        return VoxelScoreTable(
            agents,
            np.array(columns[0], np.int32),
            np.array(columns[1], np.int64),
            np.array(columns[2], np.int64),
            np.array(columns[3], np.uint64),
            np.array(columns[4], np.uint32),
        )

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        with self._lock:
            selected = self._select(agent_id, keys)
        return VoxelBatch(
            np.array([key for key, _ in selected], np.int64),
            np.array([update.kappa_sum for _, update in selected], np.uint64),
            np.array([update.count for _, update in selected], np.uint32),
            from_bytes(b"".join(update.records for _, update in selected)),
        )

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        with self._lock:
            return {agent_id: self.batch(agent_id, keys) for agent_id in self.agents()}

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

    def _select(self, agent_id: str, keys: Int64[ndarray, " k"] | None) -> list[tuple[int, _VoxelUpdate]]:
        stored = self._updates.get(agent_id, {})
        if keys is None:
            return sorted(stored.items())
        return [(key, stored[key]) for key in sorted(set(keys.tolist())) if key in stored]
