"""The voxel vote (Sec. III-E): on each voxel the Gaussians of the agent with the highest Σkappa are kept.

All functions are pure functions of the latest voxel updates. So the fused map does not depend on the order of arrival,
and voxels can be fused in shards whose union is the whole map.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, find_in, gather_rows
from gausslite.fusion.score_index import SCORES, VoxelScoreTable

PREFERRED = np.dtype([("keys", "<i8"), ("sources", "<u4"), ("kappa_sums", "<u8")])
Preferred = NDArray[Any]
"""Voxels, keys ascending, that a map wins as long as it has at least this Σkappa there, and the hash of its name."""
_NO_PREFERRED = np.zeros(0, PREFERRED)


@dataclass(frozen=True, slots=True, eq=False)
class VoteResult:
    """The agents' scores on every voxel that holds Gaussians, best first within a voxel; tombstones have no score.

    Voxel i has the key keys[i] (ascending) and the scores offsets[i] : offsets[i + 1] of `ranked`; the first one wins.
    """

    ranked: VoxelScoreTable
    offsets: Int64[ndarray, " v1"]

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def winners(self) -> VoxelScoreTable:
        """The winner's score on each voxel."""
        return self.ranked.take(self.offsets[:-1])

    @property
    def keys(self) -> Int64[ndarray, " v"]:
        """The voxels, ascending."""
        return np.ascontiguousarray(self.winners.scores["keys"])


@dataclass(frozen=True, slots=True, eq=False)
class FusedMap:
    """The winner's Gaussians on every voxel that has any, sorted by voxel, and the result of the vote."""

    batch: VoxelBatch
    vote: VoteResult


def source_hashes(names: Sequence[str]) -> UInt32[ndarray, " n"]:
    """Return a hash of each map's name."""
    return np.array([zlib.crc32(name.encode()) for name in names], np.uint32)


def rank_voxels(table: VoxelScoreTable, preferred: Preferred = _NO_PREFERRED) -> VoteResult:
    """Rank the agents on each voxel by (preferred, higher Σkappa, more Gaussians, lower agent id)."""
    keys, kappa_sums, counts = (table.scores[name] for name in ("keys", "kappa_sums", "counts"))
    is_preferred = np.zeros(len(keys), np.bool_)
    if len(preferred):
        place = find_in(preferred["keys"], keys)
        is_own = preferred["sources"][place] == source_hashes(table.agents)[table.agent_index]
        is_preferred = (place >= 0) & is_own & (preferred["kappa_sums"][place] <= kappa_sums)
    # the bitwise complement of an unsigned number sorts it in descending order
    order = np.lexsort((table.agent_index, ~counts, ~kappa_sums, ~is_preferred, keys))
    ranked = table.take(order[counts[order] > 0])  # a tombstone wins nothing
    starts = np.unique(ranked.scores["keys"], return_index=True)[1]
    return VoteResult(ranked, np.append(starts, len(ranked)).astype(np.int64))


def fuse(batch_by_agent: Mapping[str, VoxelBatch]) -> FusedMap:
    """Return the fused map of these agents' latest updates; the order of the mapping has no influence."""
    table, gaussians, starts = _stack(batch_by_agent)
    vote = rank_voxels(table)
    winners = vote.winners.scores
    keys, sums, counts = (np.ascontiguousarray(winners[name]) for name in ("keys", "kappa_sums", "counts"))
    won = gaussians.take(gather_rows(starts[winners["rows"]], counts))  # a voxel is of one agent alone, never mixed
    return FusedMap(VoxelBatch(keys, sums, counts, won), vote)


def union_maps(batch_by_agent: Mapping[str, VoxelBatch]) -> VoxelBatch:
    """Return all agents' Gaussians, sorted by voxel and then by agent id, with the sums of the agents' totals."""
    table, gaussians, starts = _stack(batch_by_agent)
    scores = table.scores.take(np.lexsort((table.agent_index, table.scores["keys"])))
    scores = scores[scores["counts"] > 0]
    keys, first = np.unique(scores["keys"], return_index=True)
    counts = scores["counts"]
    return VoxelBatch(
        keys,
        np.add.reduceat(scores["kappa_sums"], first) if len(first) else np.zeros(0, np.uint64),
        np.add.reduceat(counts, first).astype(np.uint32) if len(first) else np.zeros(0, np.uint32),
        gaussians.take(gather_rows(starts[scores["rows"]], counts)),
    )


def _stack(batch_by_agent: Mapping[str, VoxelBatch]) -> tuple[VoxelScoreTable, Gaussians, Int64[ndarray, " w"]]:
    """Return the table of all updates, their Gaussians, and the first Gaussian's place for each row of the table."""
    agents = tuple(sorted(batch_by_agent))
    batches = [batch_by_agent[agent_id] for agent_id in agents]
    agent_index = np.repeat(np.arange(len(agents), dtype=np.int32), [len(batch) for batch in batches])
    # the vote does not use sequence numbers
    scores = np.zeros(len(agent_index), SCORES)
    for name in ("keys", "kappa_sums", "counts") if batches else ():
        scores[name] = np.concatenate([getattr(batch, name) for batch in batches])
    scores["rows"] = np.arange(len(scores))
    starts = np.cumsum(scores["counts"], dtype=np.int64) - scores["counts"]
    gaussians = Gaussians.concatenate([batch.gaussians for batch in batches])
    return VoxelScoreTable(agents, agent_index, scores), gaussians, starts
