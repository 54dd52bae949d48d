"""The values that a store takes and returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32, Int64, UInt32, UInt64
from numpy import ndarray


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """An agent's permission to contribute, from joining until it leaves or joins again."""

    session_id: str
    agent_id: str


@dataclass(frozen=True, slots=True, eq=False)
class PutOutcome:
    """The voxels of a message that were stored, and those that were stale; keys in ascending order."""

    accepted: Int64[ndarray, " a"]
    stale: Int64[ndarray, " s"]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelScoreTable:
    """The totals of every update (tombstones included) without the Gaussians: the input of the vote.

    agent_index holds indices into `agents`, which is sorted; rows are sorted by (agent, key).
    """

    agents: tuple[str, ...]
    agent_index: Int32[ndarray, " w"]
    keys: Int64[ndarray, " w"]
    update_seqs: Int64[ndarray, " w"]
    kappa_sums: UInt64[ndarray, " w"]
    counts: UInt32[ndarray, " w"]


@dataclass(frozen=True, slots=True, eq=False)
class StoredScores:
    """The totals of an agent's updates of some voxels; update_seq is -1 where it has no update."""

    update_seqs: Int64[ndarray, " k"]
    kappa_sums: UInt64[ndarray, " k"]
    counts: UInt32[ndarray, " k"]

    @classmethod
    def missing(cls, voxels: int) -> StoredScores:
        """Return the totals of an agent without updates."""
        return cls(np.full(voxels, -1, np.int64), np.zeros(voxels, np.uint64), np.zeros(voxels, np.uint32))


@dataclass(frozen=True, slots=True)
class AgentTotals:
    """Sums over an agent's updates: voxels with and without tombstones, Gaussians, Σkappa; the highest update_seq."""

    voxels: int = 0
    occupied_voxels: int = 0
    gaussians: int = 0
    kappa_sum: int = 0
    highest_update_seq: int = 0

    def replace_part(self, removed: StoredScores, added: StoredScores) -> AgentTotals:
        """Return the totals after `added` replaced `removed`."""
        return AgentTotals(
            self.voxels + len(added.counts) - int(np.count_nonzero(removed.update_seqs >= 0)),
            self.occupied_voxels + int(np.count_nonzero(added.counts)) - int(np.count_nonzero(removed.counts)),
            self.gaussians + int(added.counts.sum(dtype=np.int64)) - int(removed.counts.sum(dtype=np.int64)),
            self.kappa_sum + _exact_sum(added.kappa_sums) - _exact_sum(removed.kappa_sums),
            max(self.highest_update_seq, int(added.update_seqs.max(initial=0))),
        )


def _exact_sum(values: UInt64[ndarray, " k"]) -> int:
    """Return a sum that cannot wrap around."""
    return (int((values >> np.uint64(32)).sum()) << 32) + int((values & np.uint64(0xFFFFFFFF)).sum())
