"""Index the totals of every update in memory by agent and voxel, so that a message costs its own size, not the map's.

The index is derived from the rows of a store. The store owns it, and changes it after a commit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from functools import reduce
from itertools import repeat
from operator import or_
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.stored import RECORD, to_records
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelBatch, select_voxels
from gausslite.fusion.store import AgentTotals, StoredScores, VoxelScoreTable

_FIRST_CAPACITY = 64
ReadBatch = Callable[[str, Int64[ndarray, " k"]], VoxelBatch]
"""Returns an agent's stored updates of some voxels."""


class ScoreIndex:
    """Totals by agent and voxel: 28 bytes a row and two dictionary entries. Not thread-safe; the store holds a lock."""

    def __init__(self) -> None:
        self._rows: dict[str, _AgentRows] = {}
        self._agents: tuple[str, ...] = ()
        # for each voxel a bit set of the agents with a row, so that a look-up asks only these agents
        self._holders: dict[int, int] = {}
        self._bits: dict[str, int] = {}

    @property
    def agents(self) -> tuple[str, ...]:
        """The ids of the agents with rows, sorted."""
        return self._agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's rows; zero for an unknown one."""
        rows = self._rows.get(agent_id)
        return AgentTotals() if rows is None else rows.totals

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's rows; empty for an unknown one."""
        rows = self._rows.get(agent_id)
        return TileDigests.sum_of(()) if rows is None else TileDigests.of(*rows.sorted_columns(None)[:2])

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order; update_seq is -1 where it has none."""
        rows = self._rows.get(agent_id)
        if rows is None:
            return StoredScores.missing(len(keys))
        return rows.stored(rows.find(keys))

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        wanted = None if keys is None else np.unique(keys)
        holders = -1 if wanted is None else self._holders_of(wanted)
        present = [index for index, agent_id in enumerate(self._agents) if self._bits[agent_id] & holders]
        parts = [self._rows[self._agents[index]].sorted_columns(wanted) for index in present]
        return VoxelScoreTable(
            self._agents,
            np.repeat(np.array(present, np.int32), [len(part[0]) for part in parts]),
            np.concatenate([np.zeros(0, np.int64), *(part[0] for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part[1] for part in parts)]),
            np.concatenate([np.zeros(0, np.uint64), *(part[2] for part in parts)]),
            np.concatenate([np.zeros(0, np.uint32), *(part[3] for part in parts)]),
        )

    def put(self, agent_id: str, keys: Int64[ndarray, " k"], scores: StoredScores) -> None:
        """Replace the agent's totals on these voxels."""
        if len(keys) == 0:
            return
        if agent_id not in self._rows:
            self._rows[agent_id] = _AgentRows()
            self._agents = tuple(sorted(self._rows))
            used = reduce(or_, self._bits.values(), 0)
            self._bits[agent_id] = ~used & (used + 1)
        bit = self._bits[agent_id]
        for key in self._rows[agent_id].put(keys, scores):
            self._holders[key] = self._holders.get(key, 0) | bit

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's rows; returns the keys of its voxels, ascending."""
        rows = self._rows.pop(agent_id, None)
        if rows is None:
            return np.zeros(0, np.int64)
        self._agents = tuple(sorted(self._rows))
        bit = self._bits.pop(agent_id)
        keys = rows.sorted_columns(None)[0]
        for key in keys.tolist():
            left = self._holders[key] & ~bit
            if left:
                self._holders[key] = left
            else:
                del self._holders[key]
        return keys

    def remove_voxels(self, agent_id: str, keys: Int64[ndarray, " k"]) -> Int64[ndarray, " r"]:
        """Delete the agent's rows of these voxels, at the cost of all its rows; returns the keys that had one."""
        if agent_id not in self._rows:
            return np.zeros(0, np.int64)
        own_keys, *columns = self._rows[agent_id].sorted_columns(None)
        removed = np.isin(own_keys, keys)
        self.remove_agent(agent_id)
        self.put(agent_id, own_keys[~removed], select_scores(StoredScores(*columns), ~removed))
        return own_keys[removed]

    def _holders_of(self, keys: Int64[ndarray, " k"]) -> int:
        return reduce(or_, map(self._holders.get, keys.tolist(), repeat(0)), 0)


def newer_voxels(index: ScoreIndex, subset: RoiSubset, read: ReadBatch) -> Bool[ndarray, " v"]:
    """Return a mask of the message's voxels that replace the stored ones.

    The higher sequence number wins; between equal ones the larger (Σkappa, count, records) does, so that the outcome
    does not depend on the order of arrival.
    """
    batch = subset.batch
    every = np.ones(len(batch), np.bool_)
    newer, same = compare_scores(scores_of(subset, every), index.stored(subset.agent_id, batch.keys))
    same_totals = same & (batch.counts > 0)
    if same_totals.any():
        received = voxel_records(select_voxels(batch, same_totals))
        stored_records = voxel_records(read(subset.agent_id, batch.keys[same_totals]))
        newer[same_totals] = [own > other for own, other in zip(received, stored_records, strict=True)]
    return newer


def compare_scores(scores: StoredScores, stored: StoredScores) -> tuple[Bool[ndarray, " v"], Bool[ndarray, " v"]]:
    """Return where the totals are those of a newer update than the stored ones, and where they are equal."""
    same_seq = scores.update_seqs == stored.update_seqs
    same_sum = scores.kappa_sums == stored.kappa_sums
    larger = (scores.kappa_sums > stored.kappa_sums) | (same_sum & (scores.counts > stored.counts))
    newer = (scores.update_seqs > stored.update_seqs) | (same_seq & larger)
    return newer, same_seq & same_sum & (scores.counts == stored.counts)


def select_scores(scores: StoredScores, selected: Bool[ndarray, " v"]) -> StoredScores:
    """Return the totals of the selected voxels."""
    return StoredScores(scores.update_seqs[selected], scores.kappa_sums[selected], scores.counts[selected])


def voxel_records(batch: VoxelBatch) -> list[bytes]:
    """Return the records of each voxel's Gaussians, see codec.records."""
    data = to_records(batch.gaussians).tobytes()
    ends = (batch.offsets * RECORD.itemsize).tolist()
    return [data[start:end] for start, end in itertools.pairwise(ends)]


def scores_of(subset: RoiSubset, selected: Bool[ndarray, " v"]) -> StoredScores:
    """Return the totals of the message's selected voxels."""
    batch = subset.batch
    sums, counts = batch.kappa_sums[selected], batch.counts[selected]
    return StoredScores(np.full(len(sums), subset.update_seq, np.int64), sums, counts)


class _AgentRows:
    """Columns of one agent's totals, in the order of arrival, and the row of each voxel."""

    def __init__(self) -> None:
        self.totals = AgentTotals()
        self._row_of: dict[int, int] = {}
        self._columns: tuple[NDArray[Any], ...] = tuple(
            np.zeros(_FIRST_CAPACITY, dtype) for dtype in (np.int64, np.int64, np.uint64, np.uint32)
        )

    def find(self, keys: Int64[ndarray, " k"]) -> Int64[ndarray, " k"]:
        """Return the row of each voxel, -1 where there is none."""
        return np.fromiter(map(self._row_of.get, keys.tolist(), repeat(-1)), np.int64, len(keys))

    def stored(self, rows: Int64[ndarray, " k"]) -> StoredScores:
        """Return the totals in these rows."""
        _, update_seqs, kappa_sums, counts = self._columns
        is_stored = rows >= 0
        return StoredScores(
            np.where(is_stored, update_seqs[rows], -1),
            np.where(is_stored, kappa_sums[rows], np.uint64(0)),
            np.where(is_stored, counts[rows], np.uint32(0)),
        )

    def sorted_columns(self, wanted: Int64[ndarray, " k"] | None) -> tuple[NDArray[Any], ...]:
        """Return keys, update_seqs, kappa_sums and counts of the wanted voxels (ascending keys), or of all."""
        if wanted is None:
            rows = np.argsort(self._columns[0][: len(self._row_of)])
        else:
            rows = self.find(wanted)
            rows = rows[rows >= 0]
        return tuple(column[rows] for column in self._columns)

    def put(self, keys: Int64[ndarray, " k"], scores: StoredScores) -> Iterable[int]:
        """Replace the totals of these voxels; returns the keys that had no row."""
        rows = self.find(keys)
        before = self.stored(rows)
        is_new = rows < 0
        new_keys: list[int] = keys[is_new].tolist()
        used = len(self._row_of)
        rows[is_new] = np.arange(used, used + len(new_keys))
        self._reserve(used + len(new_keys))
        self._row_of.update(zip(new_keys, range(used, used + len(new_keys)), strict=True))
        values = keys, scores.update_seqs, scores.kappa_sums, scores.counts
        for column, value in zip(self._columns, values, strict=True):
            column[rows] = value
        self.totals = self.totals.replace_part(before, scores)
        return new_keys

    def _reserve(self, size: int) -> None:
        capacity = len(self._columns[0])
        if size > capacity:
            extra = max(size, 2 * capacity) - capacity
            self._columns = tuple(np.concatenate([c, np.zeros(extra, c.dtype)]) for c in self._columns)
