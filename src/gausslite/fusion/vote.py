"""The voxel vote (Sec. III-E): on each voxel the Gaussians of the agent with the highest Σkappa are kept.

All functions are pure functions of the latest voxel updates. So the fused map does not depend on the order of arrival,
and voxels can be fused in shards whose union is the whole map.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt32, UInt64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, VoxelScore, VoxelVotes, gather_rows, group_by_voxel
from gausslite.fusion.store_values import VoxelScoreTable


@dataclass(frozen=True, slots=True, eq=False)
class VoteResult:
    """The agents' scores on every voxel that holds Gaussians, best first within a voxel; tombstones have no score.

    Voxel i has the key keys[i] (ascending) and the scores offsets[i] : offsets[i + 1]; the first one wins.
    agent_index holds indices into `agents`.
    """

    agents: tuple[str, ...]
    keys: Int64[ndarray, " v"]
    offsets: Int64[ndarray, " v1"]
    agent_index: Int32[ndarray, " s"]
    update_seqs: Int64[ndarray, " s"]
    kappa_sums: UInt64[ndarray, " s"]
    counts: UInt32[ndarray, " s"]

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def winner_index(self) -> Int32[ndarray, " v"]:
        """For each voxel the index into `agents` of the winner."""
        first: Int32[ndarray, " v"] = self.agent_index[self.offsets[:-1]]
        return first

    def votes(self) -> Iterator[VoxelVotes]:
        """Yield the result on each voxel as an object, in key order."""
        for i, key in enumerate(self.keys.tolist()):
            rows = range(int(self.offsets[i]), int(self.offsets[i + 1]))
            yield VoxelVotes(
                key,
                tuple(
                    VoxelScore(self.agents[self.agent_index[row]], int(self.kappa_sums[row]), int(self.counts[row]))
                    for row in rows
                ),
            )


@dataclass(frozen=True, slots=True, eq=False)
class FusedMap:
    """The winner's Gaussians on every voxel that has any, and the result of the vote."""

    batch: VoxelBatch
    vote: VoteResult

    @property
    def gaussians(self) -> Gaussians:
        """The fused map, sorted by voxel."""
        return self.batch.gaussians

    @property
    def provenance(self) -> Int32[ndarray, " n"]:
        """For each Gaussian the index into vote.agents of its agent."""
        return np.repeat(self.vote.winner_index, self.batch.counts)

    def won_by(self, agent_id: str) -> Bool[ndarray, " v"]:
        """True for the voxels this agent wins."""
        is_agent = np.array([name == agent_id for name in self.vote.agents], np.bool_)
        won: Bool[ndarray, " v"] = is_agent[self.vote.winner_index]
        return won


def rank_voxels(scores: VoxelScoreTable) -> VoteResult:
    """Rank the agents on each voxel by (higher Σkappa, more Gaussians, lower agent id)."""
    order, is_first = _ranking(scores)
    keys = scores.keys[order]
    return VoteResult(
        agents=scores.agents,
        keys=keys[is_first],
        offsets=np.append(np.flatnonzero(is_first), len(order)).astype(np.int64),
        agent_index=scores.agent_index[order],
        update_seqs=scores.update_seqs[order],
        kappa_sums=scores.kappa_sums[order],
        counts=scores.counts[order],
    )


def fuse(batch_by_agent: Mapping[str, VoxelBatch]) -> FusedMap:
    """Return the fused map of these agents' latest updates; the order of the mapping has no influence."""
    scores, gaussians, starts = _stack(batch_by_agent)
    order, is_first = _ranking(scores)
    winners = order[is_first]
    counts = scores.counts[winners]
    batch = VoxelBatch(
        scores.keys[winners],
        scores.kappa_sums[winners],
        counts,
        gaussians.take(gather_rows(starts[winners], counts)),
    )
    return FusedMap(batch, rank_voxels(scores))


def union_maps(batch_by_agent: Mapping[str, VoxelBatch]) -> VoxelBatch:
    """Return all agents' Gaussians, sorted by voxel and then by agent id, with the sums of the agents' totals."""
    scores, gaussians, starts = _stack(batch_by_agent)
    order = np.lexsort((scores.agent_index, scores.keys))
    order = order[scores.counts[order] > 0]
    keys, first = np.unique(scores.keys[order], return_index=True)
    counts = scores.counts[order]
    return VoxelBatch(
        keys,
        np.add.reduceat(scores.kappa_sums[order], first) if len(first) else np.zeros(0, np.uint64),
        np.add.reduceat(counts, first).astype(np.uint32) if len(first) else np.zeros(0, np.uint32),
        gaussians.take(gather_rows(starts[order], counts)),
    )


def _ranking(scores: VoxelScoreTable) -> tuple[Int64[ndarray, " s"], Bool[ndarray, " s"]]:
    """Return the rows with Gaussians, sorted by voxel and then best first, and a mask of each voxel's first row."""
    # the bitwise complement of an unsigned number sorts it in descending order
    order = np.lexsort((scores.agent_index, ~scores.counts, ~scores.kappa_sums, scores.keys))
    order = order[scores.counts[order] > 0]
    keys = scores.keys[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = keys[1:] != keys[:-1]
    return order, is_first


def _stack(batch_by_agent: Mapping[str, VoxelBatch]) -> tuple[VoxelScoreTable, Gaussians, Int64[ndarray, " w"]]:
    """Return all updates as one table, all Gaussians as one array, and the first Gaussian's row for each update."""
    agents = tuple(sorted(batch_by_agent))
    batches = [batch_by_agent[agent_id] for agent_id in agents]
    counts = np.concatenate([np.zeros(0, np.uint32), *(batch.counts for batch in batches)])
    scores = VoxelScoreTable(
        agents,
        np.repeat(np.arange(len(agents), dtype=np.int32), [len(batch) for batch in batches]),
        np.concatenate([np.zeros(0, np.int64), *(batch.keys for batch in batches)]),
        np.zeros(len(counts), np.int64),  # the vote does not use sequence numbers
        np.concatenate([np.zeros(0, np.uint64), *(batch.kappa_sums for batch in batches)]),
        counts,
    )
    starts = np.cumsum(counts, dtype=np.int64) - counts
    return scores, Gaussians.concatenate([batch.gaussians for batch in batches]), starts


def fuse_maps(maps: Mapping[str, Gaussians], grid: VoxelGrid) -> FusedMap:
    """Return the fused map: each voxel holds the Gaussians of the agent with the highest Σkappa there (Sec. III-E).

    maps: the complete map of each agent id.
    Raises InvalidInputError if a mean is outside the grid.
    """
    return fuse({agent_id: group_by_voxel(gaussians, grid) for agent_id, gaussians in maps.items()})
