"""The voxel updates as the vote reads them: in the fused frame, without quarantined agents; and who is preferred."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.errors import CodecError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, group_by_voxel, merge_batches, select_keys, select_voxels
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.moved_voxels import PAIRS, MovedVoxels, Pairs
from gausslite.fusion.score_index import SCORES, VoxelScoreTable
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import PREFERRED, Preferred, VoteResult, rank_voxels, source_hashes

SLICE_VOXELS = 128
MOVED_BYTES = 260
"""What a voxel takes beside its own bytes while it is used in another frame; measured."""
_RECORD = "", "preferred"
"""Owner and name of the stored preferences."""
_NO_KEYS = np.zeros(0, np.int64)


class VoteInput:
    """Reads the updates from the store, and moves those of agents in other frames.

    The index has the totals of the moved voxels; their Gaussians are moved when they are read. So a message, or a slice
    of a map whose frame changes, costs its own voxels. Not thread-safe; FusedMapLayers holds a lock.
    """

    def __init__(self, store: FusionStore, frames: Mapping[str, FrameAlignment], grid: VoxelGrid) -> None:
        """frames: of the agents, as far as they have one. Raises CodecError, StorageError."""
        self._store, self._grid = store, grid
        data = b"" if store.is_shared else store.find_record(*_RECORD)
        if len(data) % PREFERRED.itemsize:
            raise CodecError(f"stored preferences: expected rows of {PREFERRED.itemsize} bytes, got {len(data)} bytes")
        self._preferred: Preferred = np.frombuffer(data, PREFERRED)
        # of the agents whose updates are not used as sent
        self._frames: dict[str, FrameAlignment] = {}
        self._moved: dict[str, MovedVoxels] = {}
        for agent_id, alignment in frames.items():
            self.set_frame(agent_id, alignment)
        for agent_id in self._frames:
            keys = store.keys(agent_id)
            for start in range(0, len(keys), SLICE_VOXELS):
                self.move(agent_id, keys[start : start + SLICE_VOXELS])

    def set_frame(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Move the agent's updates by this alignment from now on; `move` those that are stored."""
        if alignment.is_identity and alignment.is_used:
            self._frames.pop(agent_id, None)
        else:
            self._frames[agent_id] = alignment

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._store.agents()

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        table = self._store.scores(keys)
        for index, agent_id in enumerate(table.agents):
            if agent_id in self._moved:
                table = self._with_moved(table, index, self._moved[agent_id], keys)
        return table

    def rank(self, keys: Int64[ndarray, " k"] | None = None) -> VoteResult:
        """Return the vote on these voxels, or on all."""
        return rank_voxels(self.scores(keys), self._preferred)

    def prefer(self, preferred: Preferred) -> Int64[ndarray, " k"]:
        """Let these maps win their voxels, also after a restart; returns the voxels that may change. StorageError."""
        before = self._preferred
        if np.array_equal(before, preferred):
            return _NO_KEYS
        self._store.save_record(*_RECORD, preferred.tobytes())
        self._preferred = preferred
        return np.unique(np.setxor1d(before, preferred)["keys"])

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"]) -> VoxelBatch:
        """Return the updates of one agent on these voxels; empty in quarantine."""
        moved = self._moved.get(agent_id)
        if moved is None:
            return self._store.batch(agent_id, keys)
        as_sent, pairs = self._store.batch(agent_id, np.unique(keys[~moved.has(keys)])), moved.pairs(keys)
        sources = self._gaussians_in_frame(agent_id, self._store.batch(agent_id, np.unique(pairs["sources"])))
        in_range = sources.take(np.flatnonzero(self._in_range(sources)))
        found = select_keys(group_by_voxel(in_range, self._grid), np.unique(pairs["cells"]))
        both = np.isin(as_sent.keys, found.keys)
        if not both.any():
            return merge_batches(as_sent, found)
        # while a map's frame changes, slice by slice, a voxel can have Gaussians of both frames
        mixed = select_voxels(as_sent, both).gaussians
        others = ~np.isin(found.keys, as_sent.keys[both])
        shared = group_by_voxel(Gaussians.concatenate([mixed, select_voxels(found, ~others).gaussians]), self._grid)
        return merge_batches(select_voxels(as_sent, ~both), select_voxels(found, others), shared)

    def batches(self, keys: Int64[ndarray, " k"]) -> dict[str, VoxelBatch]:
        """Return the updates of every agent on these voxels."""
        batches = self._store.batches(keys)
        return {name: self.batch(name, keys) if name in self._moved else batch for name, batch in batches.items()}

    def move(self, agent_id: str, sources: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Move these voxels of the agent by its alignment; returns the fused voxels that may change.

        Raises StorageError; then `leave_out` these voxels, which would count as sent.
        """
        alignment = self._frames.get(agent_id)
        if alignment is None and agent_id not in self._moved:
            return sources
        moved = self._moved.setdefault(agent_id, MovedVoxels())
        if alignment is None:
            changed = np.union1d(sources, moved.remove(sources))
            if moved.is_empty:
                del self._moved[agent_id]
            return changed
        pairs = np.zeros(0, PAIRS)
        if alignment.is_used:
            batch = self._store.batch(agent_id, sources)
            gaussians = self._gaussians_in_frame(agent_id, batch)
            rows = np.flatnonzero(self._in_range(gaussians))
            pairs = _totals_by_cell(batch, gaussians.take(rows), rows, self._grid)
        return moved.replace(sources, pairs)

    def leave_out(self, agent_id: str, sources: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Use nothing of these voxels until they are moved; returns the fused voxels that may change."""
        return self._moved.setdefault(agent_id, MovedVoxels()).replace(sources, np.zeros(0, PAIRS))

    def memory_bytes(self, agent_id: str) -> int:
        """Return the memory that the agent's moved voxels take."""
        return self._moved[agent_id].memory_bytes if agent_id in self._moved else 0

    def begin_map(self, agent_id: str, moved: Sequence[str], dropped: Sequence[str]) -> str:
        """Begin another map of an agent; as FusionStore.begin_map. Raises StorageError."""
        former = self._store.begin_map(agent_id, moved, dropped)
        if agent_id in self._frames:
            self._frames[former] = self._frames.pop(agent_id)
        if agent_id in self._moved:
            self._moved[former] = self._moved.pop(agent_id)
        renamed, (name, other) = self._preferred.copy(), source_hashes([agent_id, former])
        renamed["sources"][renamed["sources"] == name] = other
        self.prefer(renamed)
        if former not in self.agents():
            self.remove_agent(former)
        return former

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " k"]:
        """Delete the agent's frame and its moved voxels; returns these."""
        self._frames.pop(agent_id, None)
        moved = self._moved.pop(agent_id, None)
        return _NO_KEYS if moved is None else np.unique(moved.pairs(None)["cells"])

    def _gaussians_in_frame(self, agent_id: str, batch: VoxelBatch) -> Gaussians:
        """Return the Gaussians in the fused frame, in their order."""
        alignment = self._frames.get(agent_id, FrameAlignment(0))
        segments = alignment.segment_of(self._store.scores_of(agent_id, batch.keys)["update_seqs"])
        used = np.unique(segments)
        if len(used) == 1:
            return move_gaussians(batch.gaussians, alignment.transform(int(used[0])))
        of_gaussian = np.repeat(segments, batch.counts)
        rows = [np.flatnonzero(of_gaussian == segment) for segment in used]
        parts = [
            move_gaussians(batch.gaussians.take(own), alignment.transform(int(segment)))
            for own, segment in zip(rows, used, strict=True)
        ]
        order = np.argsort(np.concatenate([np.zeros(0, np.int64), *rows]))
        return Gaussians.concatenate(parts).take(order)

    def _in_range(self, gaussians: Gaussians) -> Bool[ndarray, " n"]:
        """Return which Gaussians are within the range of the grid; the others are dropped."""
        inside: Bool[ndarray, " n"] = (np.abs(gaussians.means_m) < 0.99 * self._grid.max_coordinate_m).all(axis=1)
        return inside

    def _with_moved(
        self, table: VoxelScoreTable, index: int, moved: MovedVoxels, keys: Int64[ndarray, " k"] | None
    ) -> VoxelScoreTable:
        """Return the table with the agent's moved voxels in place of those of the index."""
        pairs = moved.pairs(keys)
        cells, at = np.unique(pairs["cells"], return_inverse=True)
        scores = np.zeros(len(cells), SCORES)
        scores["keys"] = cells
        np.add.at(scores["kappa_sums"], at, pairs["kappas"])
        np.add.at(scores["counts"], at, pairs["counts"])
        own = np.flatnonzero(table.agent_index == index)
        as_sent = table.scores[own]
        is_shared = np.isin(as_sent["keys"], cells)
        is_sent = ~moved.has(as_sent["keys"])
        # as sent, beside what other voxels have there
        shared = as_sent[is_shared & is_sent & (as_sent["counts"] > 0)]
        for field in ("kappa_sums", "counts"):
            scores[field][cells.searchsorted(shared["keys"])] += shared[field]
        kept = np.ones(len(table), np.bool_)
        kept[own] = is_sent & ~is_shared
        changed = VoxelScoreTable(
            table.agents,
            np.append(table.agent_index[kept], np.full(len(cells), index, np.int32)),
            np.concatenate([table.scores[kept], scores]),
        )
        return changed.take(np.lexsort((changed.scores["keys"], changed.agent_index)))


def _totals_by_cell(batch: VoxelBatch, moved: Gaussians, rows: Int64[ndarray, " n"], grid: VoxelGrid) -> Pairs:
    """Return the pairs of source and fused voxel with their totals; rows: the moved Gaussians' rows in the batch."""
    sources, cells = np.repeat(batch.keys, batch.counts)[rows], grid.keys(moved.means_m)
    order = np.lexsort((cells, sources))
    sources, cells = sources[order], cells[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (sources[1:] != sources[:-1]) | (cells[1:] != cells[:-1])
    starts = np.flatnonzero(is_first)
    pairs = np.zeros(len(starts), PAIRS)
    if len(starts):
        pairs["sources"], pairs["cells"] = sources[starts], cells[starts]
        pairs["kappas"] = np.add.reduceat(moved.kappa[order], starts, dtype=np.uint64)
        pairs["counts"] = np.diff(starts, append=len(order))
    return pairs
