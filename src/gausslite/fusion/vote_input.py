"""The voxel updates as the vote reads them: in the fused frame, without quarantined agents."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, group_by_voxel, merge_batches, select_keys, select_voxels
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.score_index import SCORES, VoxelScoreTable
from gausslite.fusion.store import FusionStore

SLICE_VOXELS = 128
_Cells = dict[int, tuple[int, int]]
"""Σkappa and number of Gaussians by voxel of the fused grid."""


class _MovedVoxels:
    """Where the voxels of an agent in another frame lie in the fused grid: a voxel has parts of several.

    Voxels that are not in the index are used as sent; a quarantined voxel is in it, without cells.
    """

    def __init__(self) -> None:
        self.cells_of: dict[int, _Cells] = {}
        self.sources_of: dict[int, set[int]] = {}

    def replace(self, source: int, cells: _Cells | None) -> set[int]:
        """Replace the cells of one voxel, None if it is used as sent; returns the fused voxels that may change."""
        before = self.cells_of.pop(source, None)
        # without an entry, the voxel was used as sent
        changed = {source} if before is None or cells is None else set()
        for cell in before or ():
            changed.add(cell)
            self.sources_of[cell].discard(source)
            if not self.sources_of[cell]:
                del self.sources_of[cell]
        if cells is not None:
            self.cells_of[source] = cells
            for cell in cells:
                changed.add(cell)
                self.sources_of.setdefault(cell, set()).add(source)
        return changed

    def totals(self, cell: int) -> tuple[int, int]:
        """Return Σkappa and number of Gaussians of a voxel of the fused grid."""
        parts = [self.cells_of[source][cell] for source in self.sources_of[cell]]
        return sum(kappa for kappa, _ in parts), sum(count for _, count in parts)


class VoteInput:
    """Reads the updates from the store, and moves those of agents in other frames.

    The index has the totals of the moved voxels; their Gaussians are moved when they are read. So a message, or a slice
    of a map whose frame changes, costs its own voxels. Not thread-safe; FusedMapLayers holds a lock.
    """

    def __init__(self, store: FusionStore, frames: Mapping[str, FrameAlignment], grid: VoxelGrid) -> None:
        """frames: of the agents, as far as they have one."""
        self._store, self._grid = store, grid
        # of the agents whose updates are not used as sent
        self._frames: dict[str, FrameAlignment] = {}
        self._moved: dict[str, _MovedVoxels] = {}
        for agent_id, alignment in frames.items():
            self.set_frame(agent_id, alignment)
        for agent_id in self._frames:
            for keys in self.slices(agent_id):
                self.move(agent_id, keys)

    def set_frame(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Move the agent's updates by this alignment from now on; `move` those that are stored."""
        if alignment.is_identity and alignment.is_used:
            self._frames.pop(agent_id, None)
        else:
            self._frames[agent_id] = alignment

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._store.agents()

    def slices(self, agent_id: str) -> Iterator[Int64[ndarray, " k"]]:
        """Yield the agent's voxels in slices, as they are now."""
        keys = self._store.keys(agent_id)
        yield from (keys[start : start + SLICE_VOXELS] for start in range(0, len(keys), SLICE_VOXELS))

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        table = self._store.scores(keys)
        for index, agent_id in enumerate(table.agents):
            if agent_id in self._moved:
                table = self._with_moved(table, index, self._moved[agent_id], keys)
        return table

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return the updates of one agent on these voxels, or on all; empty in quarantine."""
        moved = self._moved.get(agent_id)
        if moved is None:
            return self._store.batch(agent_id, keys)
        if keys is None:
            as_sent = self._store.batch(agent_id)
            as_sent = select_voxels(as_sent, ~np.isin(as_sent.keys, _array(moved.cells_of)))
        else:
            as_sent = self._store.batch(agent_id, _array(set(keys.tolist()) - moved.cells_of.keys()))
        cells = list(moved.sources_of) if keys is None else [key for key in keys.tolist() if key in moved.sources_of]
        sources = set().union(*(moved.sources_of[cell] for cell in cells))
        found = select_keys(self._move(agent_id, _array(sources)), _array(cells))
        both = np.isin(as_sent.keys, found.keys)
        if not both.any():
            return merge_batches(as_sent, found)
        # while a map's frame changes, slice by slice, a voxel can have Gaussians of both frames
        mixed = select_voxels(as_sent, both).gaussians
        others = ~np.isin(found.keys, as_sent.keys[both])
        shared = group_by_voxel(Gaussians.concatenate([mixed, select_voxels(found, ~others).gaussians]), self._grid)
        return merge_batches(select_voxels(as_sent, ~both), select_voxels(found, others), shared)

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the updates of every agent on these voxels, or on all."""
        batches = self._store.batches(keys)
        return {name: self.batch(name, keys) if name in self._moved else batch for name, batch in batches.items()}

    def move(self, agent_id: str, sources: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Move these voxels of the agent by its alignment; returns the fused voxels that may change.

        Raises StorageError; then `leave_out` these voxels, which would count as sent.
        """
        alignment = self._frames.get(agent_id)
        if alignment is None and agent_id not in self._moved:
            return sources
        moved = self._moved.setdefault(agent_id, _MovedVoxels())
        changed: set[int] = set()
        if alignment is None:
            for source in sources.tolist():
                changed |= {source} | moved.replace(source, None)
            if not moved.cells_of:
                del self._moved[agent_id]
            return _array(changed)
        cells_of: dict[int, _Cells] = {source: {} for source in sources.tolist()}
        if alignment.is_used:
            batch = self._store.batch(agent_id, sources)
            gaussians = self._gaussians_in_frame(agent_id, batch)
            rows = np.flatnonzero(self._in_range(gaussians))
            for source, cell, kappa, count in _totals_by_cell(batch, gaussians.take(rows), rows, self._grid):
                cells_of[source][cell] = kappa, count
        for source, cells in cells_of.items():
            changed |= moved.replace(source, cells)
        return _array(changed)

    def leave_out(self, agent_id: str, sources: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Use nothing of these voxels until they are moved; returns the fused voxels that may change."""
        moved = self._moved.setdefault(agent_id, _MovedVoxels())
        return _array(set().union(*(moved.replace(source, {}) for source in sources.tolist())))

    def begin_map(self, agent_id: str, moved: Sequence[str], dropped: Sequence[str]) -> str:
        """Begin another map of an agent; as FusionStore.begin_map. Raises StorageError."""
        former = self._store.begin_map(agent_id, moved, dropped)
        if agent_id in self._frames:
            self._frames[former] = self._frames.pop(agent_id)
        if agent_id in self._moved:
            self._moved[former] = self._moved.pop(agent_id)
        if former not in self.agents():
            self.remove_agent(former)
        return former

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " k"]:
        """Delete the agent's frame and its moved voxels; returns these."""
        self._frames.pop(agent_id, None)
        moved = self._moved.pop(agent_id, None)
        return _array(() if moved is None else moved.sources_of)

    def _move(self, agent_id: str, sources: Int64[ndarray, " s"]) -> VoxelBatch:
        gaussians = self._gaussians_in_frame(agent_id, self._store.batch(agent_id, sources))
        return group_by_voxel(gaussians.take(np.flatnonzero(self._in_range(gaussians))), self._grid)

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
        self, table: VoxelScoreTable, index: int, moved: _MovedVoxels, keys: Int64[ndarray, " k"] | None
    ) -> VoxelScoreTable:
        """Return the table with the agent's moved voxels in place of those of the index."""
        wanted = moved.sources_of if keys is None else [key for key in keys.tolist() if key in moved.sources_of]
        totals = {key: moved.totals(key) for key in wanted}
        kept = np.ones(len(table), np.bool_)
        own = np.flatnonzero(table.agent_index == index)
        for place, (key, _, kappa, count, _) in zip(own.tolist(), table.scores[own].tolist(), strict=True):
            kept[place] = key not in moved.cells_of and key not in totals
            if key in totals and key not in moved.cells_of and count:
                # as sent, beside what other voxels have there
                totals[key] = totals[key][0] + kappa, totals[key][1] + count
        scores = np.zeros(len(totals), SCORES)
        scores["keys"] = list(totals)
        scores["kappa_sums"], scores["counts"] = np.array(list(totals.values()), np.uint64).reshape(-1, 2).T
        changed = VoxelScoreTable(
            table.agents,
            np.append(table.agent_index[kept], np.full(len(totals), index, np.int32)),
            np.concatenate([table.scores[kept], scores]),
        )
        return changed.take(np.lexsort((changed.scores["keys"], changed.agent_index)))


def _totals_by_cell(
    batch: VoxelBatch, moved: Gaussians, rows: Int64[ndarray, " n"], grid: VoxelGrid
) -> Iterator[tuple[int, int, int, int]]:
    """Yield source voxel, fused voxel, Σkappa and number of Gaussians of each pair; rows: the Gaussians in the batch"""
    if len(rows) == 0:
        return
    sources, cells = np.repeat(batch.keys, batch.counts)[rows], grid.keys(moved.means_m)
    order = np.lexsort((cells, sources))
    sources, cells = sources[order], cells[order]
    is_first = np.ones(len(order), np.bool_)
    is_first[1:] = (sources[1:] != sources[:-1]) | (cells[1:] != cells[:-1])
    starts = np.flatnonzero(is_first)
    sums = np.add.reduceat(moved.kappa[order], starts, dtype=np.uint64)
    counts = np.diff(starts, append=len(order))
    yield from zip(sources[starts].tolist(), cells[starts].tolist(), sums.tolist(), counts.tolist(), strict=True)


def _array(keys: Iterable[int]) -> Int64[ndarray, " k"]:
    """Return these voxel keys, ascending."""
    return np.array(sorted(keys), np.int64)
