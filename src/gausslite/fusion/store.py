"""The store of voxel updates: (agent, voxel) → the agent's latest update of that voxel.

An update replaces the agent's earlier update of the voxel if its sequence number is higher, and otherwise it is STALE.
Between equal numbers the larger content wins. So duplicates, resends and reordering change nothing, and removing an
agent leaves no trace. An update without Gaussians is a tombstone. It is kept, because an older update of the voxel may
still arrive.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.tile_digests import TileDigests
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store_values import AgentTotals, PutOutcome, SessionRecord, StoredScores, VoxelScoreTable


@runtime_checkable
class FusionStore(Protocol):
    """Owns the voxel updates, the mission's configuration and the sessions. Thread-safe.

    incarnation_id changes when the content may be older than what was acknowledged: with a new store, after a restore
    and after a repair. Then the agents compare digests and send what is missing.

    When a method of a durable store has returned, its effect survives a crash. All methods raise StorageError if the
    storage refuses; the store stays usable for other calls.
    """

    @property
    def incarnation_id(self) -> str:
        """The id of this content; see the class."""
        ...

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message completely, or nothing of it on an error. Raises InvalidInputError."""
        ...

    def put_all(self, subsets: Sequence[RoiSubset]) -> list[PutOutcome]:
        """Store messages of different agents in one transaction: all, or none on an error. Raises InvalidInputError."""
        ...

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        ...

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        ...

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        ...

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        ...

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        ...

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        ...

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        ...

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        ...

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        ...

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration."""
        ...

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        ...

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        ...

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        ...

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        ...

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        ...

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        ...

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist."""
        ...

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent, such as its objects; it replaces the earlier one."""
        ...

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one."""
        ...

    def close(self) -> None:
        """Close the files; no other method may be called afterwards."""
        ...


def require_storable(subset: RoiSubset) -> None:
    """Raise InvalidInputError if a number of the message does not fit the store's signed 64-bit columns."""
    largest_sum = int(subset.batch.kappa_sums.max(initial=0))
    limit = int(np.iinfo(np.int64).max)
    numbers = (("update_seq", subset.update_seq), ("message_seq", subset.message_seq), ("kappa_sum", largest_sum))
    for name, value in numbers:
        if value > limit:
            raise InvalidInputError(f"subset {name}: expected at most {limit}, got {value}")
