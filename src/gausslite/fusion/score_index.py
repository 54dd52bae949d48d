"""Index the totals of every update in memory by map and voxel, so that a message costs its own size, not the map's.

The index is derived from the rows of a store. The store owns it, and changes it after a commit.
"""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.encoded_voxels import RECORD, EncodedSubset, EncodedVoxels, join_elements, to_records
from gausslite.domain.voxel_changes import TileDigests, hash_columns
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.packed_table import PackedTable, Table, keys_of, places_of, tiles_at

_COLUMNS = [("update_seqs", "i8"), ("kappa_sums", "u8"), ("counts", "u4"), ("rows", "i8")]
SCORES = np.dtype([("keys", "i8"), *_COLUMNS])
Scores = NDArray[Any]
"""An element of SCORES for each of an agent's updates: its totals, and the store's row that has its Gaussians.

update_seq and row are -1 where the agent has no update of a voxel.
"""
VOXEL_BYTES, TILE_BYTES = 65, 400
"""What a voxel, and each map's tile with voxels, take in memory here and in the change log; measured."""
COMPARED_VOXELS, COMPARED_BYTES = 4096, 48
"""Of how many voxels of a map a FrameAligner may keep something, and how much of each."""
MORE_ROWS_BYTES, ROW_BYTES = 200, 9
"""What the rows of a tile beside the first take, together and each."""
_LEAST_SIZE = 16
"""What a tile that is deleted costs at least, in voxels."""
VOXEL_UNITS = 2
"""The size of a voxel beside its Gaussians, in units of one Gaussian."""
ROWS = np.dtype([("tiles", "i8"), ("numbers", "i8"), ("sizes", "i8")])
"""Rows of a store: their tiles, numbers, and sizes in units."""
_TILES = np.dtype([("written", "u4"), ("used", "u4"), ("digests", "u8"), ("rows", "i8")])
_NO_TILE = np.array((0, 0, 0, -1), _TILES)
_PACKED = np.dtype(_COLUMNS)
_NO_VOXEL = np.array((-1, 0, 0, -1), _PACKED)
ReadVoxels = Callable[[str, Int64[ndarray, " k"]], Sequence[EncodedVoxels]]
"""Returns an agent's stored updates of some voxels in parts, each with ascending keys."""


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

    def replace_part(self, removed: Table, added: Table) -> AgentTotals:
        """Return the totals after `added` replaced `removed`."""
        counts, counts_before = added["counts"], removed["counts"]
        return AgentTotals(
            self.voxels + len(added) - int(np.count_nonzero(removed["update_seqs"] >= 0)),
            self.occupied_voxels + int(np.count_nonzero(counts)) - int(np.count_nonzero(counts_before)),
            self.gaussians + int(counts.sum(dtype=np.int64)) - int(counts_before.sum(dtype=np.int64)),
            # Python's integers cannot wrap around
            self.kappa_sum + sum(added["kappa_sums"].tolist()) - sum(removed["kappa_sums"].tolist()),
            max(self.highest_update_seq, int(added["update_seqs"].max(initial=0))),
        )


class _Map:
    """The totals of one map, by voxel and by tile.

    tiles: the size of a tile's rows in the store (written) and of the voxels that are still valid in them (used), in
    units; its digest and its first row. more_rows: the others of tiles that have several; added_rows: their number.
    """

    def __init__(self) -> None:
        self.voxels, self.tiles = PackedTable(_NO_VOXEL), PackedTable(_NO_TILE)
        self.more_rows: dict[int, array[int]] = {}
        self.totals = AgentTotals()
        self.added_rows = 0

    @property
    def memory_bytes(self) -> int:
        """What it takes here, in the change log and in an aligner."""
        tables = VOXEL_BYTES * len(self.voxels) + TILE_BYTES * len(self.tiles)
        tables += COMPARED_BYTES * min(len(self.voxels), COMPARED_VOXELS)
        return tables + MORE_ROWS_BYTES * len(self.more_rows) + ROW_BYTES * self.added_rows


_NO_MAP = _Map()


class ScoreIndex:
    """Totals by map and voxel. Not thread-safe; the store holds a lock."""

    def __init__(self) -> None:
        self._maps: dict[str, _Map] = {}
        # by the place of a tile: the maps that have voxels there, so that a message asks no others
        self._at: dict[int, set[_Map]] = {}
        self.agents: tuple[str, ...] = ()
        """The names of the maps with rows, sorted."""

    def _map(self, name: str) -> _Map:
        return self._maps.get(name, _NO_MAP)

    def totals(self, name: str) -> AgentTotals:
        """Return the sums over a map's rows; zero for an unknown one."""
        return self._map(name).totals

    def memory_bytes(self, names: Iterable[str], name: str, added: Int64[ndarray, " k"]) -> int:
        """Return the memory that these maps take, see _Map, with voxels added to one, at most."""
        tiles = np.count_nonzero(self._map(name).tiles.get(np.unique(tiles_at(places_of(added))))["written"] == 0)
        before = sum(self._maps[own].memory_bytes for own in names)
        return before + (VOXEL_BYTES + COMPARED_BYTES) * len(added) + TILE_BYTES * int(tiles)

    def digests(self, name: str) -> TileDigests:
        """Return the digests of a map's rows, which are kept with each change; empty for an unknown one."""
        places, tiles = self._map(name).tiles.select()
        return TileDigests(keys_of(places), np.ascontiguousarray(tiles["digests"]))

    def places(self, name: str) -> Int64[ndarray, " v"]:
        """Return the places of a map's voxels, which later changes leave as they are."""
        return self._map(name).voxels.select()[0]

    def scores_of(self, name: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the map's totals on these voxels, in their order."""
        return _scores(keys, self._map(name).voxels.get(places_of(keys)))

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return the totals of all maps on these voxels, or on all."""
        keys = None if keys is None else np.unique(keys)
        near = self._near(keys)
        maps = [(number, self._maps[name]) for number, name in enumerate(self.agents) if self._maps[name] in near]
        return VoxelScoreTable(self.agents, *_sorted_scores(maps, keys))

    def sorted_scores(self, name: str, keys: Int64[ndarray, " k"] | None = None) -> Scores:
        """Return the map's totals on those of these voxels, all different, that it has, or on all; keys ascend."""
        return _sorted_scores([(0, self._map(name))], keys)[1]

    def put(self, name: str, scores: Scores) -> None:
        """Replace the map's totals on the voxels of the scores; `add_rows` came before."""
        own, keys, added = self._maps[name], np.ascontiguousarray(scores["keys"]), np.empty(len(scores), _PACKED)
        for column, _ in _COLUMNS:
            added[column] = scores[column]
        places = places_of(keys)
        before = own.voxels.put(places, added)
        # each tile changes by the difference of its voxels, so that a message costs its own size
        was_there = before["rows"] >= 0
        sizes = added["counts"].astype(np.int64) + VOXEL_UNITS
        sizes -= np.where(was_there, before["counts"].astype(np.int64) + VOXEL_UNITS, 0)
        hashes = hash_columns(keys, added["update_seqs"])
        hashes -= np.where(was_there, hash_columns(keys, before["update_seqs"]), np.uint64(0))
        numbers, index = np.unique(tiles_at(places), return_inverse=True)
        tiles = own.tiles.get(numbers)
        # unsigned numbers wrap around, so that a decrease is the addition of a large one
        np.add.at(tiles["used"], index, sizes.astype(np.uint32))
        np.add.at(tiles["digests"], index, hashes)
        own.tiles.put(numbers, tiles)
        own.totals = own.totals.replace_part(before, added)

    def outdated_rows(self, name: str, tiles: Int64[ndarray, " t"], spare: int, at_most: int) -> dict[int, list[int]]:
        """Return the rows to write anew of tiles that are outdated by more than half and by more than `spare` units.

        at_most: units of the rows, about.
        """
        own = self._map(name)
        found = own.tiles.get(places_of(tiles))
        written, used = (found[column].astype(np.int64) for column in ("written", "used"))
        outdated = np.flatnonzero(written - used > np.maximum(used, spare))
        outdated = outdated[np.cumsum(written[outdated]) - written[outdated] < at_most]
        rows = zip(tiles[outdated].tolist(), found["rows"][outdated].tolist(), strict=True)
        return {tile: [row, *own.more_rows.get(tile, ())] for tile, row in rows}

    def add_rows(self, name: str, rows: Table, emptied: Collection[int] = ()) -> None:
        """Add ROWS to tiles of a map; emptied: those that have none of their earlier rows any more."""
        if name not in self._maps:
            self._maps[name] = _Map()
            self.agents = tuple(sorted(self._maps))
        own, tiles = self._maps[name], rows["tiles"]
        places, first, index = np.unique(places_of(tiles), return_index=True, return_inverse=True)
        found = own.tiles.get(places)
        # the rows of emptied tiles leave first, because the new ones are counted from zero
        gone = places.searchsorted(places_of(np.array(list(emptied), np.int64)))
        found["written"][gone], found["rows"][gone] = 0, -1
        for tile in emptied:
            own.added_rows -= len(own.more_rows.pop(tile, ()))
        np.add.at(found["written"], index, rows["sizes"].astype(np.uint32))
        # most tiles have one row, which the table holds without an object of its own
        is_first = found["rows"] < 0
        found["rows"][is_first] = rows["numbers"][first[is_first]]
        own.tiles.put(places, found)
        for place in places.tolist():
            self._at.setdefault(place, set()).add(own)
        more = np.delete(rows, first[is_first])
        own.added_rows += len(more)
        for tile, number, _ in more.tolist():
            own.more_rows.setdefault(tile, array("q")).append(number)

    def last_tiles(self, name: str, at_most: int) -> tuple[int, list[int]]:
        """Return the place where a map's last tiles begin, with about so many voxels, and the rows of these tiles."""
        own, size, rows = self._map(name), 0, list[int]()
        places, tiles = own.tiles.last(max(at_most // _LEAST_SIZE, 1))
        voxels = own.voxels.last(len(own.voxels))[0]
        counts = np.diff(voxels.searchsorted(places), append=len(voxels))
        # from the end, where deleting moves no other voxel of the table
        first, columns = len(places), (keys_of(places), counts, tiles["rows"])
        for tile, count, row in zip(*(column[::-1].tolist() for column in columns), strict=True):
            own_rows = [row, *own.more_rows.get(tile, ())]
            rows, first, size = rows + own_rows, first - 1, size + max(count, len(own_rows), _LEAST_SIZE)
            if size >= at_most:
                break
        return int(places[first]) if rows else 0, rows

    def remove_from(self, name: str, place: int) -> Int64[ndarray, " v"]:
        """Delete a map's rows in the tiles from this place on; returns the keys of their voxels, ascending.

        A map without tiles is unknown.
        """
        if name not in self._maps:
            return np.zeros(0, np.int64)
        own = self._maps[name]
        tiles = own.tiles.remove_from(place)[0]
        for tile, at in zip(keys_of(tiles).tolist(), tiles.tolist(), strict=True):
            own.added_rows -= len(own.more_rows.pop(tile, ()))
            self._at[at].discard(own)
            if not self._at[at]:
                del self._at[at]
        places, removed = own.voxels.remove_from(place)
        own.totals = own.totals.replace_part(removed, removed[:0])
        if len(own.tiles) == 0:
            del self._maps[name]
            self.agents = tuple(sorted(self._maps))
        return np.sort(keys_of(places))

    def _near(self, keys: Int64[ndarray, " k"] | None) -> set[_Map]:
        """Return the maps with voxels in the tiles of these ones; all for None."""
        if keys is None:
            return set(self._maps.values())
        tiles = np.unique(tiles_at(places_of(keys))).tolist()
        return set[_Map]().union(*(self._at.get(tile, ()) for tile in tiles))

    def rename(self, name: str, other: str) -> None:
        """Give a map another name, if it exists."""
        if name in self._maps:
            self._maps[other] = self._maps.pop(name)
            self.agents = tuple(sorted(self._maps))


def _sorted_scores(maps: Sequence[tuple[int, _Map]], keys: Int64[ndarray, " k"] | None) -> tuple[ndarray, Scores]:
    """Return the totals of numbered maps on these voxels, or on all, with their numbers; sorted by number and key."""
    places = None if keys is None else places_of(keys)
    parts = [(number, *part) for number, own in maps for part in own.voxels.parts(places)]
    numbers = np.repeat(np.array([part[0] for part in parts], np.int32), [len(part[1]) for part in parts])
    found = np.concatenate([np.zeros(0, np.int64), *(part[1] for part in parts)])
    scores = _scores(keys_of(found), join_elements([np.zeros(0, _PACKED), *(part[2] for part in parts)]))
    order = np.lexsort((scores["keys"], numbers))
    order = order[scores["rows"][order] >= 0]
    return numbers[order], scores.take(order)


def _scores(keys: Int64[ndarray, " k"], packed: Table) -> Scores:
    scores = np.empty(len(keys), SCORES)
    scores["keys"] = keys
    for column, _ in _COLUMNS:
        scores[column] = packed[column]
    return scores


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
