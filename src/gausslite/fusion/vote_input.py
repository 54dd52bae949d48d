"""The voxel updates as the vote reads them, in the fused frame without quarantined agents; what agents saw as free."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.codec.stored import MAX_BLOCKS, decode_free_space, encode_free_space
from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.free_space import FreeSpace
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxels import (
    VoxelBatch,
    VoxelGrid,
    VoxelIndex,
    empty_batch,
    group_by_voxel,
    select_keys,
    select_voxels,
)
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameAlignments
from gausslite.fusion.store import FusionStore, VoxelScoreTable

RECORD = "free_space"
_STORED_BYTES = 1 << 23
MIN_VIEWS = 2
"""Views of one agent that have to agree: one view may have a wrong depth or pose."""


class FreeSpaceRecords:
    """Each agent's free space, in the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore, grid: VoxelGrid) -> None:
        self._store, self.grid = store, grid
        stored = store.records(RECORD).items()
        self._by_agent = {agent_id: decode_free_space(data, _STORED_BYTES)[0] for agent_id, data in stored}

    def contribute(self, agent_id: str, blocks: FreeSpace) -> None:
        """Replace these blocks of an agent. Raises QuotaError, InvalidInputError for blocks out of the grid's range."""
        blocks.require_within(self.grid)
        after = self._by_agent.get(agent_id, FreeSpace.empty()).replace_blocks(blocks)
        if len(after.keys) > MAX_BLOCKS:
            raise QuotaError(f"free space: expected at most {MAX_BLOCKS} blocks of an agent, got {len(after.keys)}")
        self._store.save_record(agent_id, RECORD, encode_free_space(after, self.grid))
        self._by_agent[agent_id] = after

    def free_voxels(self, agent_id: str) -> int:
        """Return the number of voxels that the agent has observed as free."""
        return self._by_agent.get(agent_id, FreeSpace.empty()).free_voxels

    def seen_by(self, agents: Collection[str], keys: Int64[ndarray, " k"]) -> Bool[ndarray, " k"]:
        """Return True for the voxels that one of these agents has observed as free in two views."""
        seen = np.zeros(len(keys), np.bool_)
        for agent_id in self._by_agent.keys() & set(agents):
            seen |= self._by_agent[agent_id].views(keys, self.grid) >= MIN_VIEWS
        return seen

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent; the store deletes its record with its updates."""
        self._by_agent.pop(agent_id, None)


class VoteInput:
    """Reads the updates from the store; the moved maps of agents in other frames are cached.

    Not thread-safe; FusionEngine holds a lock.
    """

    def __init__(self, store: FusionStore, alignments: FrameAlignments, grid: VoxelGrid) -> None:
        self._store, self._alignments, self._grid = store, alignments, grid
        self._moved: dict[str, VoxelBatch] = {}
        self._trackers: dict[str, VoxelChangeTracker] = {}
        for agent_id in store.agents():
            if not self._is_as_sent(agent_id):
                self.refresh(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._store.agents()

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        table = self._store.scores(keys)
        if not self._moved:
            return table
        kept = ~np.isin(table.agent_index, [i for i, name in enumerate(table.agents) if name in self._moved])
        moved = {i: _select(self._moved[name], keys) for i, name in enumerate(table.agents) if name in self._moved}
        return _merge_scores(table, kept, moved)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return the updates of one agent on these voxels, or on all; empty in quarantine."""
        is_moved = agent_id in self._moved
        return _select(self._moved[agent_id], keys) if is_moved else self._store.batch(agent_id, keys)

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the updates of every agent on these voxels, or on all."""
        batches = self._store.batches(keys)
        return {
            name: _select(self._moved[name], keys) if name in self._moved else batch for name, batch in batches.items()
        }

    def refresh(self, agent_id: str) -> Int64[ndarray, " k"]:
        """Recompute the agent's moved map after its updates or its alignment changed; returns the voxels to compare.

        These are the voxels of the fused grid where the vote may read other data than before.
        """
        before = self._moved.pop(agent_id, None)
        sent = self._store.batch(agent_id)
        if self._is_as_sent(agent_id):
            self._trackers.pop(agent_id, None)
            return sent.keys if before is None else np.union1d(before.keys, sent.keys)
        tracker = self._trackers.get(agent_id)
        is_first = tracker is None
        if tracker is None:
            tracker = self._trackers[agent_id] = VoxelChangeTracker()
        moved = self._move(agent_id, sent)
        voxels = VoxelIndex.from_points(moved.gaussians.means_m, self._grid)
        signatures = VoxelSignatures.from_gaussians(moved.gaussians, voxels)
        changed, removed = tracker.update(signatures)
        self._moved[agent_id] = moved
        keys = np.union1d(signatures.keys[changed], removed)
        return np.union1d(keys, sent.keys) if is_first else keys

    def changed_keys(self, agent_id: str, accepted: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Return the voxels of the fused grid that these accepted updates of the agent may change."""
        return accepted if self._is_as_sent(agent_id) else self.refresh(agent_id)

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " k"]:
        """Forget the agent's moved map; returns its voxels."""
        self._trackers.pop(agent_id, None)
        moved = self._moved.pop(agent_id, None)
        return np.zeros(0, np.int64) if moved is None else moved.keys

    def _is_as_sent(self, agent_id: str) -> bool:
        alignment = self._alignments.get(agent_id)
        return alignment.is_identity and alignment.state is not AlignmentState.QUARANTINED

    def _move(self, agent_id: str, sent: VoxelBatch) -> VoxelBatch:
        alignment = self._alignments.get(agent_id)
        if alignment.state is AlignmentState.QUARANTINED:
            return empty_batch()
        return move_batch(sent, self._store.stored(agent_id, sent.keys).update_seqs, alignment, self._grid)


def move_batch(
    batch: VoxelBatch, update_seqs: Int64[ndarray, " v"], alignment: FrameAlignment, grid: VoxelGrid
) -> VoxelBatch:
    """Return the Gaussians of an agent's updates in the fused frame, grouped by the fused map's voxels.

    Gaussians that leave the range of the grid are dropped.
    """
    segments = alignment.segment_of(update_seqs)
    parts = [
        move_gaussians(select_voxels(batch, segments == segment).gaussians, alignment.transform(int(segment)))
        for segment in np.unique(segments)
    ]
    gaussians = Gaussians.concatenate(parts)
    try:
        return group_by_voxel(gaussians, grid)
    except InvalidInputError:
        inside = (np.abs(gaussians.means_m) < 0.99 * grid.max_coordinate_m).all(axis=1)
        return group_by_voxel(gaussians.take(inside), grid)


def _select(batch: VoxelBatch, keys: Int64[ndarray, " k"] | None) -> VoxelBatch:
    return batch if keys is None else select_keys(batch, keys)


def _merge_scores(table: VoxelScoreTable, kept: ndarray, moved: Mapping[int, VoxelBatch]) -> VoxelScoreTable:
    """Return the kept rows and those of the moved batches, sorted by agent and key."""
    index = np.concatenate(
        [table.agent_index[kept], *(np.full(len(batch), i, np.int32) for i, batch in moved.items())]
    ).astype(np.int32)
    keys = np.concatenate([table.keys[kept], *(batch.keys for batch in moved.values())])
    order = np.lexsort((keys, index))
    zeros = [np.zeros(len(batch), np.int64) for batch in moved.values()]
    return VoxelScoreTable(
        table.agents,
        index[order],
        keys[order],
        np.concatenate([table.update_seqs[kept], *zeros])[order],
        np.concatenate([table.kappa_sums[kept], *(batch.kappa_sums for batch in moved.values())])[order],
        np.concatenate([table.counts[kept], *(batch.counts for batch in moved.values())])[order],
    )
