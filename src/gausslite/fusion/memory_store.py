"""The register in memory: fast, for one mission at a time, gone when the process ends."""

from __future__ import annotations

from dataclasses import dataclass
from threading import RLock

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.records import from_bytes, to_records
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.store import MissionConfig, PutOutcome, SessionRecord, VoxelScoreTable, require_storable


@dataclass(frozen=True, slots=True)
class _Word:
    """What one agent last said about one voxel; the records are those of codec.records."""

    map_revision: int
    kappa_sum: int
    count: int
    records: bytes


class MemoryStore:
    """A FusionStore in dictionaries. 63 bytes a Gaussian and about 250 a voxel."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._words: dict[str, dict[int, _Word]] = {}
        self._sessions: dict[str, SessionRecord] = {}
        self._charter: MissionConfig | None = None

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Take in one message; a word that is not newer than the one held is stale. Raises InvalidInputError."""
        require_storable(subset)
        words, offsets = subset.batch, subset.batch.offsets
        records = to_records(words.gaussians)
        accepted = np.zeros(len(words), np.bool_)
        with self._lock:
            held = self._words.setdefault(subset.agent_id, {})
            for i, key in enumerate(words.keys.tolist()):
                word = held.get(key)
                if word is not None and word.map_revision >= subset.map_revision:
                    continue
                # tobytes copies, so that a small word does not keep a whole message alive
                row = records[offsets[i] : offsets[i + 1]].tobytes()
                held[key] = _Word(subset.map_revision, int(words.kappa_sums[i]), int(words.counts[i]), row)
                accepted[i] = True
            if not held:
                del self._words[subset.agent_id]
        return PutOutcome(words.keys[accepted], words.keys[~accepted])

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Forget an agent's words; returns the voxels it had words on, ascending."""
        with self._lock:
            return np.array(sorted(self._words.pop(agent_id, {})), np.int64)

    def agents(self) -> tuple[str, ...]:
        """The agents that have words here, sorted."""
        with self._lock:
            return tuple(sorted(self._words))

    def highest_map_revision(self, agent_id: str) -> int:
        """The newest revision among an agent's words; 0 when it has none."""
        with self._lock:
            return max((word.map_revision for word in self._words.get(agent_id, {}).values()), default=0)

    def stakes(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Totals of all agents, on these voxels or on all."""
        with self._lock:
            agents = self.agents()
            rows = [
                (index, key, word.map_revision, word.kappa_sum, word.count)
                for index, agent_id in enumerate(agents)
                for key, word in self._select(agent_id, keys)
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

    def words(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """An agent's latest words (tombstones too), on these voxels or on all; none for an unknown agent."""
        with self._lock:
            chosen = self._select(agent_id, keys)
        return VoxelBatch(
            np.array([key for key, _ in chosen], np.int64),
            np.array([word.kappa_sum for _, word in chosen], np.uint64),
            np.array([word.count for _, word in chosen], np.uint32),
            from_bytes(b"".join(word.records for _, word in chosen)),
        )

    def table(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Every agent's words at one instant."""
        with self._lock:
            return {agent_id: self.words(agent_id, keys) for agent_id in self.agents()}

    def mission_config(self) -> MissionConfig | None:
        """What was agreed by the first to join; None before that."""
        with self._lock:
            return self._charter

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Agree on this from now on."""
        with self._lock:
            self._charter = mission_config

    def sessions(self) -> tuple[SessionRecord, ...]:
        """All sessions that were saved and not ended, by session id."""
        with self._lock:
            return tuple(sorted(self._sessions.values(), key=lambda session: session.session_id))

    def save_session(self, session: SessionRecord) -> None:
        """Remember a session; it replaces any other session of the same agent."""
        with self._lock:
            others = {s.session_id for s in self._sessions.values() if s.agent_id == session.agent_id}
            for session_id in others:
                del self._sessions[session_id]
            self._sessions[session.session_id] = session

    def end_session(self, session_id: str) -> None:
        """Forget a session; unknown ones are fine. The agent's words stay."""
        with self._lock:
            self._sessions.pop(session_id, None)

    def close(self) -> None:
        """Nothing to let go of."""

    def _select(self, agent_id: str, keys: Int64[ndarray, " k"] | None) -> list[tuple[int, _Word]]:
        held = self._words.get(agent_id, {})
        if keys is None:
            return sorted(held.items())
        wanted = sorted(set(keys.tolist()))
        return [(key, held[key]) for key in wanted if key in held]
