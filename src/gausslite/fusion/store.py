"""The register of the fusion law: (agent, voxel) -> the agent's latest word, and nothing else is remembered.

It is no accumulator: a word replaces the agent's earlier word on that voxel when its map revision is higher, and is
STALE otherwise. So duplicates, resends and reordering change nothing, and an agent can be taken out again as if it
had never been there. An empty word is a tombstone and is kept, since an older word may still be on its way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int32, Int64, UInt32, UInt64
from numpy import ndarray

from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class MissionConfig:
    """What all words in one store have in common; set once, by the first agent that joins."""

    mission_id: str
    world_frame: str
    voxel_size_m: float


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """An agent's right to contribute, from joining until leaving or joining again."""

    session_id: str
    agent_id: str


@dataclass(frozen=True, slots=True, eq=False)
class PutOutcome:
    """Which voxels of a message became the agent's latest word, and which were duplicates or overtaken; ascending."""

    accepted: Int64[ndarray, " a"]
    stale: Int64[ndarray, " s"]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelScoreTable:
    """The totals of every word (tombstones too), without the Gaussians: all that the vote looks at.

    agent indexes `agents`, which is sorted; rows are in the order of (agent, key).
    """

    agents: tuple[str, ...]
    agent: Int32[ndarray, " w"]
    keys: Int64[ndarray, " w"]
    map_revisions: Int64[ndarray, " w"]
    kappa_sums: UInt64[ndarray, " w"]
    counts: UInt32[ndarray, " w"]


@runtime_checkable
class FusionStore(Protocol):
    """Owns the register, the mission_config and the sessions. Every method may be called from any thread.

    What a method has returned from is as durable as the store is: after a kill the next life of a durable store
    has it. All raise StorageError when the storage refuses; the store stays usable for what it still can do.
    """

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Take in one message, all of it or (on an error) nothing. Raises InvalidInputError."""
        ...

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Forget an agent's words; returns the voxels it had words on, ascending."""
        ...

    def agents(self) -> tuple[str, ...]:
        """The agents that have words here, sorted."""
        ...

    def highest_map_revision(self, agent_id: str) -> int:
        """The newest revision among an agent's words; 0 when it has none."""
        ...

    def stakes(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Totals of all agents, on these voxels or on all."""
        ...

    def words(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """An agent's latest words (tombstones too), on these voxels or on all; none for an unknown agent."""
        ...

    def table(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Every agent's words at one instant."""
        ...

    def mission_config(self) -> MissionConfig | None:
        """What was agreed by the first to join; None before that."""
        ...

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Agree on this from now on."""
        ...

    def sessions(self) -> tuple[SessionRecord, ...]:
        """All sessions that were saved and not ended, by session id."""
        ...

    def save_session(self, session: SessionRecord) -> None:
        """Remember a session; it replaces any other session of the same agent."""
        ...

    def end_session(self, session_id: str) -> None:
        """Forget a session; unknown ones are fine. The agent's words stay."""
        ...

    def close(self) -> None:
        """Let go of files; no other method may be called after."""
        ...


def require_storable(subset: RoiSubset) -> None:
    """Raise InvalidInputError when a number of the message does not fit the register's 64-bit columns."""
    largest = int(subset.batch.kappa_sums.max(initial=0))
    limit = int(np.iinfo(np.int64).max)
    for name, value in (("map_revision", subset.map_revision), ("sequence", subset.sequence), ("kappa_sum", largest)):
        if value > limit:
            raise InvalidInputError(f"subset {name}: expected at most {limit}, got {value}")
