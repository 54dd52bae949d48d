"""The voxel vote of Sec. III-E: on each voxel the agent that trained it most keeps its Gaussians.

Everything here is a pure function of the table of latest words, so the fused map does not depend on the order in
which they came, and the voxels can be fused in shards whose union is the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt32, UInt64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import gather_rows
from gausslite.domain.voxels import VoxelScore, VoxelVotes
from gausslite.fusion.store import VoxelScoreTable


@dataclass(frozen=True, slots=True, eq=False)
class VoteResult:
    """The stakes on every voxel that has any, best first within a voxel; empty words hold no stake.

    Voxel i has the key keys[i] (ascending) and the stakes offsets[i] : offsets[i + 1]; the first one wins.
    agent indexes `agents`.
    """

    agents: tuple[str, ...]
    keys: Int64[ndarray, " v"]
    offsets: Int64[ndarray, " v1"]
    agent: Int32[ndarray, " s"]
    kappa_sums: UInt64[ndarray, " s"]
    counts: UInt32[ndarray, " s"]

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def winner(self) -> Int32[ndarray, " v"]:
        """Index into `agents` of the agent that keeps each voxel."""
        first: Int32[ndarray, " v"] = self.agent[self.offsets[:-1]]
        return first

    def votes(self) -> Iterator[VoxelVotes]:
        """The outcome on each voxel, in key order, for people and logs."""
        for i, key in enumerate(self.keys.tolist()):
            rows = range(int(self.offsets[i]), int(self.offsets[i + 1]))
            yield VoxelVotes(
                key,
                tuple(
                    VoxelScore(self.agents[self.agent[row]], int(self.kappa_sums[row]), int(self.counts[row]))
                    for row in rows
                ),
            )


@dataclass(frozen=True, slots=True, eq=False)
class FusedMap:
    """The winners' words on every voxel that has any, and the election that chose them."""

    words: VoxelBatch
    election: VoteResult

    @property
    def gaussians(self) -> Gaussians:
        """The fused map, sorted by voxel."""
        return self.words.gaussians

    @property
    def provenance(self) -> Int32[ndarray, " n"]:
        """For each Gaussian the index into election.agents of the agent it came from."""
        return np.repeat(self.election.winner, self.words.counts)

    def won_by(self, agent_id: str) -> Bool[ndarray, " v"]:
        """True for the voxels this agent keeps."""
        won: Bool[ndarray, " v"] = np.array([name == agent_id for name in self.election.agents], np.bool_)[
            self.election.winner
        ]
        return won


def elect(stakes: VoxelScoreTable) -> VoteResult:
    """Rank the stakes of each voxel by (higher Σkappa, more Gaussians, lower agent id)."""
    order, first = _ranked(stakes)
    keys = stakes.keys[order]
    return VoteResult(
        stakes.agents,
        keys[first],
        np.append(np.flatnonzero(first), len(order)).astype(np.int64),
        stakes.agent[order],
        stakes.kappa_sums[order],
        stakes.counts[order],
    )


def fuse(words_by_agent: Mapping[str, VoxelBatch]) -> FusedMap:
    """The fused map of these agents' latest words; the order of the mapping plays no part."""
    stakes, gaussians, starts = _side_by_side(words_by_agent)
    order, first = _ranked(stakes)
    winners = order[first]
    counts = stakes.counts[winners]
    words = VoxelBatch(
        stakes.keys[winners],
        stakes.kappa_sums[winners],
        counts,
        gaussians.take(gather_rows(starts[winners], counts)),
    )
    return FusedMap(words, elect(stakes))


def concatenate(words_by_agent: Mapping[str, VoxelBatch]) -> VoxelBatch:
    """Every agent's Gaussians side by side: within a voxel by agent id; totals are added up."""
    stakes, gaussians, starts = _side_by_side(words_by_agent)
    order = np.lexsort((stakes.agent, stakes.keys))
    order = order[stakes.counts[order] > 0]
    keys, first = np.unique(stakes.keys[order], return_index=True)
    counts = stakes.counts[order]
    return VoxelBatch(
        keys,
        np.add.reduceat(stakes.kappa_sums[order], first) if len(first) else np.zeros(0, np.uint64),
        np.add.reduceat(counts, first).astype(np.uint32) if len(first) else np.zeros(0, np.uint32),
        gaussians.take(gather_rows(starts[order], counts)),
    )


def _ranked(stakes: VoxelScoreTable) -> tuple[Int64[ndarray, " s"], Bool[ndarray, " s"]]:
    """Rows of non-empty words sorted by voxel and then best first, and where each voxel begins."""
    # the bitwise complement of an unsigned number sorts it from the highest down
    order = np.lexsort((stakes.agent, ~stakes.counts, ~stakes.kappa_sums, stakes.keys))
    order = order[stakes.counts[order] > 0]
    keys = stakes.keys[order]
    first = np.ones(len(order), np.bool_)
    first[1:] = keys[1:] != keys[:-1]
    return order, first


def _side_by_side(words_by_agent: Mapping[str, VoxelBatch]) -> tuple[VoxelScoreTable, Gaussians, Int64[ndarray, " w"]]:
    """All words as one table, all Gaussians as one array, and the row at which each word's Gaussians start."""
    agents = tuple(sorted(words_by_agent))
    parts = [words_by_agent[agent_id] for agent_id in agents]
    counts = np.concatenate([np.zeros(0, np.uint32), *(part.counts for part in parts)])
    stakes = VoxelScoreTable(
        agents,
        np.repeat(np.arange(len(agents), dtype=np.int32), [len(part) for part in parts]),
        np.concatenate([np.zeros(0, np.int64), *(part.keys for part in parts)]),
        np.zeros(len(counts), np.int64),  # revisions have no say in the vote
        np.concatenate([np.zeros(0, np.uint64), *(part.kappa_sums for part in parts)]),
        counts,
    )
    starts = np.cumsum(counts, dtype=np.int64) - counts
    return stakes, Gaussians.concatenate([part.gaussians for part in parts]), starts
