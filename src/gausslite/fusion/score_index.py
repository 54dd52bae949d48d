"""Index the totals of every update in memory by agent and voxel, so that a message costs its own size, not the map's.

The index is derived from the rows of a store. The store owns it, and changes it after a commit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import repeat
from operator import or_
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.encoded_voxels import RECORD, EncodedSubset, EncodedVoxels, join_elements, to_records
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import VoxelBatch

SCORES = np.dtype([("keys", "i8"), ("update_seqs", "i8"), ("kappa_sums", "u8"), ("counts", "u4"), ("rows", "i8")])
Scores = NDArray[Any]
"""An element of SCORES for each of an agent's updates: its totals, and the store's row that has its Gaussians.

update_seq and row are -1 where the agent has no update of a voxel.
"""
NO_SCORES: Scores = np.zeros(0, SCORES)


@dataclass(frozen=True, slots=True, eq=False)
class VoxelScoreTable:
    """The totals of every update (tombstones included) without the Gaussians: the input of the vote.

    agent_index holds indices into `agents`, which is sorted; the scores are sorted by (agent, key).
    """

    agents: tuple[str, ...]
    agent_index: Int32[ndarray, " w"]
    scores: Scores

    def __len__(self) -> int:
        return len(self.scores)

    def take(self, places: Int64[ndarray, " s"]) -> VoxelScoreTable:
        """Return the scores at these places."""
        return VoxelScoreTable(self.agents, self.agent_index[places], self.scores.take(places))


@dataclass(frozen=True, slots=True)
class AgentTotals:
    """Sums over an agent's updates: voxels with and without tombstones, Gaussians, Σkappa; the highest update_seq."""

    voxels: int = 0
    occupied_voxels: int = 0
    gaussians: int = 0
    kappa_sum: int = 0
    highest_update_seq: int = 0

    def replace_part(self, removed: Scores, added: Scores) -> AgentTotals:
        """Return the totals after `added` replaced `removed`."""
        counts, counts_before = added["counts"], removed["counts"]
        return AgentTotals(
            self.voxels + len(added) - int(np.count_nonzero(removed["update_seqs"] >= 0)),
            self.occupied_voxels + int(np.count_nonzero(counts)) - int(np.count_nonzero(counts_before)),
            self.gaussians + int(counts.sum(dtype=np.int64)) - int(counts_before.sum(dtype=np.int64)),
            self.kappa_sum + _exact_sum(added["kappa_sums"]) - _exact_sum(removed["kappa_sums"]),
            max(self.highest_update_seq, int(added["update_seqs"].max(initial=0))),
        )


def _exact_sum(values: UInt64[ndarray, " k"]) -> int:
    """Return a sum that cannot wrap around."""
    return sum(values.tolist())


_FIRST_CAPACITY = 64
_MISSING = np.zeros((), SCORES)
_MISSING["update_seqs"] = _MISSING["rows"] = -1
ReadVoxels = Callable[[str, Int64[ndarray, " k"]], Sequence[EncodedVoxels]]
"""Returns an agent's stored updates of some voxels in parts, each with ascending keys."""


class ScoreIndex:
    """Totals by agent and voxel: 36 bytes a row and two dictionary entries. Not thread-safe; the store holds a lock."""

    def __init__(self) -> None:
        self._rows: dict[str, _AgentRows] = {}
        self.agents: tuple[str, ...] = ()
        """The ids of the agents with rows, sorted."""
        # for each voxel a bit set of the agents with a row, so that a look-up asks only these agents
        self._holders: dict[int, int] = {}
        self._bits: dict[str, int] = {}

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's rows; zero for an unknown one."""
        return self._rows.get(agent_id, _NO_ROWS).totals

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's rows; empty for an unknown one."""
        scores = self.sorted_scores(agent_id)
        return TileDigests.of(scores["keys"], scores["update_seqs"])

    def scores_of(self, agent_id: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the agent's totals on these voxels, in their order."""
        rows = self._rows.get(agent_id, _NO_ROWS)
        return rows.stored(rows.find(keys))

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        wanted = None if keys is None else np.unique(keys)
        holders = -1 if wanted is None else reduce(or_, map(self._holders.get, wanted.tolist(), repeat(0)), 0)
        present = [index for index, agent_id in enumerate(self.agents) if self._bits[agent_id] & holders]
        parts = [self._rows[self.agents[index]].sorted_scores(wanted) for index in present]
        agent_index = np.repeat(np.array(present, np.int32), [len(part) for part in parts])
        return VoxelScoreTable(self.agents, agent_index, join_elements([NO_SCORES, *parts]))

    def sorted_scores(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> Scores:
        """Return the agent's totals on those of these voxels (ascending keys) that it has, or on all."""
        return self._rows.get(agent_id, _NO_ROWS).sorted_scores(keys)

    def put(self, agent_id: str, scores: Scores) -> Scores:
        """Replace the agent's totals on the voxels of the scores; returns those from before."""
        if agent_id not in self._rows:
            self._rows[agent_id] = _AgentRows()
            self.agents = tuple(sorted(self._rows))
            used = reduce(or_, self._bits.values(), 0)
            self._bits[agent_id] = ~used & (used + 1)
        bit = self._bits[agent_id]
        new_keys, before = self._rows[agent_id].put(scores)
        for key in new_keys:
            self._holders[key] = self._holders.get(key, 0) | bit
        return before

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's rows; returns the keys of its voxels, ascending."""
        rows = self._rows.pop(agent_id, None)
        if rows is None:
            return np.zeros(0, np.int64)
        self.agents = tuple(sorted(self._rows))
        bit = self._bits.pop(agent_id)
        keys = rows.sorted_scores(None)["keys"].copy()
        for key in keys.tolist():
            left = self._holders[key] & ~bit
            if left:
                self._holders[key] = left
            else:
                del self._holders[key]
        return keys


def newer_voxels(index: ScoreIndex, update: EncodedSubset, read: ReadVoxels) -> Bool[ndarray, " v"]:
    """Return a mask of the message's voxels that replace the stored ones.

    The higher sequence number wins; between equal ones the larger (Σkappa, count, records) does, so that the outcome
    does not depend on the order of arrival.
    """
    keys, table = update.voxels.keys, update.voxels.voxels
    stored = index.scores_of(update.agent_id, keys)
    newer: Bool[ndarray, " v"] = stored["update_seqs"] < update.update_seq
    same_seq = stored["update_seqs"] == update.update_seq
    if same_seq.any():
        sums, counts = table["kappa_sums"], table["counts"]
        same_sum = stored["kappa_sums"] == sums
        newer |= same_seq & ((sums > stored["kappa_sums"]) | (same_sum & (counts > stored["counts"])))
        equal = np.flatnonzero(same_seq & same_sum & (counts == stored["counts"]) & (counts > 0))
        for part in read(update.agent_id, keys[equal]) if len(equal) else ():
            places = np.searchsorted(keys, part.keys)
            newer[places] = _are_larger(update.voxels.take(places), part)
    return newer


def _are_larger(received: EncodedVoxels, stored: EncodedVoxels) -> list[bool]:
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
    """One agent's totals, in the order of arrival, and the row of each voxel among them."""

    def __init__(self) -> None:
        self.totals = AgentTotals()
        self._row_of: dict[int, int] = {}
        self._scores: Scores = np.zeros(_FIRST_CAPACITY, SCORES)

    def find(self, keys: Int64[ndarray, " k"]) -> Int64[ndarray, " k"]:
        """Return the row of each voxel, -1 where there is none."""
        return np.fromiter(map(self._row_of.get, keys.tolist(), repeat(-1)), np.int64, len(keys))

    def stored(self, rows: Int64[ndarray, " k"]) -> Scores:
        """Return the totals in these rows."""
        # `take` copies elements as they are, an index copies them field by field
        found = self._scores.take(rows)
        found[rows < 0] = _MISSING
        return found

    def sorted_scores(self, wanted: Int64[ndarray, " k"] | None) -> Scores:
        """Return the totals of the wanted voxels (ascending keys), or of all."""
        if wanted is None:
            rows = np.argsort(self._scores["keys"][: len(self._row_of)])
        else:
            rows = self.find(wanted)
            rows = rows[rows >= 0]
        return self._scores.take(rows)

    def put(self, scores: Scores) -> tuple[list[int], Scores]:
        """Replace the totals of the voxels of the scores; returns the keys that had none, and those from before."""
        keys = scores["keys"]
        rows = self.find(keys)
        before = self.stored(rows)
        is_new = rows < 0
        new_keys: list[int] = keys[is_new].tolist()
        used = len(self._row_of)
        rows[is_new] = np.arange(used, used + len(new_keys))
        self._reserve(used + len(new_keys))
        self._row_of.update(zip(new_keys, range(used, used + len(new_keys)), strict=True))
        self._scores[rows] = scores
        self.totals = self.totals.replace_part(before, scores)
        return new_keys, before

    def _reserve(self, size: int) -> None:
        capacity = len(self._scores)
        if size > capacity:
            extra = max(size, 2 * capacity) - capacity
            self._scores = np.concatenate([self._scores, np.zeros(extra, SCORES)])


_NO_ROWS = _AgentRows()
