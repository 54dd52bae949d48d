"""Index the totals of every update in memory by agent and voxel, so that a message costs its own size, not the map's.

The index is derived from the rows of a store. The store owns it, and changes it after a commit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import reduce
from itertools import repeat
from operator import or_
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.stored import RECORD, to_records
from gausslite.codec.stored_voxels import StoredSubset, StoredVoxels
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.store_values import AgentTotals, StoredScores, VoxelScoreTable

_FIRST_CAPACITY = 64
_DTYPES = (np.int64, np.int64, np.uint64, np.uint32, np.int64)
_NO_COLUMNS: tuple[NDArray[Any], ...] = tuple(np.zeros(0, dtype) for dtype in _DTYPES)
ReadVoxels = Callable[[str, Int64[ndarray, " k"]], Sequence[StoredVoxels]]
"""Returns an agent's stored updates of some voxels in parts, each with ascending keys."""


class ScoreIndex:
    """Totals by agent and voxel: 36 bytes a row and two dictionary entries. Not thread-safe; the store holds a lock."""

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

    def columns(self, agent_id: str, keys: Int64[ndarray, " k"] | None) -> tuple[NDArray[Any], ...]:
        """Return keys, update_seqs, kappa_sums, counts and rows of an agent's voxels (ascending keys), or of all."""
        rows = self._rows.get(agent_id)
        return _NO_COLUMNS if rows is None else rows.sorted_columns(keys)

    def put(self, agent_id: str, keys: Int64[ndarray, " k"], scores: StoredScores) -> StoredScores:
        """Replace the agent's totals on these voxels; returns those from before."""
        if agent_id not in self._rows:
            self._rows[agent_id] = _AgentRows()
            self._agents = tuple(sorted(self._rows))
            used = reduce(or_, self._bits.values(), 0)
            self._bits[agent_id] = ~used & (used + 1)
        bit = self._bits[agent_id]
        new_keys, before = self._rows[agent_id].put(keys, scores)
        for key in new_keys:
            self._holders[key] = self._holders.get(key, 0) | bit
        return before

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

    def _holders_of(self, keys: Int64[ndarray, " k"]) -> int:
        return reduce(or_, map(self._holders.get, keys.tolist(), repeat(0)), 0)


def newer_voxels(index: ScoreIndex, update: StoredSubset, read: ReadVoxels) -> Bool[ndarray, " v"]:
    """Return a mask of the message's voxels that replace the stored ones.

    The higher sequence number wins; between equal ones the larger (Σkappa, count, records) does, so that the outcome
    does not depend on the order of arrival.
    """
    keys, table = update.voxels.keys, update.voxels.voxels
    stored = index.stored(update.agent_id, keys)
    newer: Bool[ndarray, " v"] = stored.update_seqs < update.update_seq
    same_seq = stored.update_seqs == update.update_seq
    if same_seq.any():
        sums, counts = table["kappa_sums"], table["counts"]
        same_sum = stored.kappa_sums == sums
        newer |= same_seq & ((sums > stored.kappa_sums) | (same_sum & (counts > stored.counts)))
        equal = np.flatnonzero(same_seq & same_sum & (counts == stored.counts) & (counts > 0))
        for part in read(update.agent_id, keys[equal]) if len(equal) else ():
            places = np.searchsorted(keys, part.keys)
            newer[places] = _are_larger(update.voxels.take(places), part)
    return newer


def _are_larger(received: StoredVoxels, stored: StoredVoxels) -> list[bool]:
    """Return which of the received voxels have larger records than the same voxels in the store."""
    if received.size_m == stored.size_m and received.content() == stored.content():
        # a duplicate, without decoding any Gaussian
        return [False] * len(received)
    pairs = zip(voxel_records(received.batch()), voxel_records(stored.batch()), strict=True)
    return [own > other for own, other in pairs]


def voxel_records(batch: VoxelBatch) -> list[bytes]:
    """Return the records of each voxel's Gaussians, see codec.records."""
    data = to_records(batch.gaussians).tobytes()
    ends = (batch.offsets * RECORD.itemsize).tolist()
    return [data[start:end] for start, end in itertools.pairwise(ends)]


class _AgentRows:
    """Columns of one agent's totals, in the order of arrival, and the row of each voxel."""

    def __init__(self) -> None:
        self.totals = AgentTotals()
        self._row_of: dict[int, int] = {}
        self._columns: tuple[NDArray[Any], ...] = tuple(np.zeros(_FIRST_CAPACITY, dtype) for dtype in _DTYPES)

    def find(self, keys: Int64[ndarray, " k"]) -> Int64[ndarray, " k"]:
        """Return the row of each voxel, -1 where there is none."""
        return np.fromiter(map(self._row_of.get, keys.tolist(), repeat(-1)), np.int64, len(keys))

    def stored(self, rows: Int64[ndarray, " k"]) -> StoredScores:
        """Return the totals in these rows."""
        _, update_seqs, kappa_sums, counts, numbers = self._columns
        is_stored = rows >= 0
        if is_stored.all():
            return StoredScores(update_seqs[rows], kappa_sums[rows], counts[rows], numbers[rows])
        return StoredScores(
            np.where(is_stored, update_seqs[rows], -1),
            np.where(is_stored, kappa_sums[rows], np.uint64(0)),
            np.where(is_stored, counts[rows], np.uint32(0)),
            np.where(is_stored, numbers[rows], -1),
        )

    def sorted_columns(self, wanted: Int64[ndarray, " k"] | None) -> tuple[NDArray[Any], ...]:
        """Return keys, update_seqs, kappa_sums, counts and rows of the wanted voxels (ascending keys), or of all."""
        if wanted is None:
            rows = np.argsort(self._columns[0][: len(self._row_of)])
        else:
            rows = self.find(wanted)
            rows = rows[rows >= 0]
        return tuple(column[rows] for column in self._columns)

    def put(self, keys: Int64[ndarray, " k"], scores: StoredScores) -> tuple[list[int], StoredScores]:
        """Replace the totals of these voxels; returns the keys that had none, and the totals from before."""
        rows = self.find(keys)
        before = self.stored(rows)
        is_new = rows < 0
        new_keys: list[int] = keys[is_new].tolist()
        used = len(self._row_of)
        rows[is_new] = np.arange(used, used + len(new_keys))
        self._reserve(used + len(new_keys))
        self._row_of.update(zip(new_keys, range(used, used + len(new_keys)), strict=True))
        values = keys, scores.update_seqs, scores.kappa_sums, scores.counts, scores.rows
        for column, value in zip(self._columns, values, strict=True):
            column[rows] = value
        self.totals = self.totals.replace_part(before, scores)
        return new_keys, before

    def _reserve(self, size: int) -> None:
        capacity = len(self._columns[0])
        if size > capacity:
            extra = max(size, 2 * capacity) - capacity
            self._columns = tuple(np.concatenate([c, np.zeros(extra, c.dtype)]) for c in self._columns)
