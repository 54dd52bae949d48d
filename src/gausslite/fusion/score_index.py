"""Index the totals of every update in memory by map and voxel, so that a message costs its own size, not the map's.

The index is derived from the rows of a store. The store owns it, and changes it after a commit.
"""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32, Int64, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.encoded_voxels import RECORD, EncodedSubset, EncodedVoxels, join_elements, to_records
from gausslite.domain.voxel_changes import TileDigests, hash_columns
from gausslite.domain.voxels import VoxelBatch, tiles_of
from gausslite.fusion.tile_tables import Table, by_tile, find, joined, keys_of, offsets_of, replaced

_COLUMNS = [("update_seqs", "i8"), ("kappa_sums", "u8"), ("counts", "u4"), ("rows", "i8")]
SCORES = np.dtype([("keys", "i8"), *_COLUMNS])
Scores = NDArray[Any]
"""An element of SCORES for each of an agent's updates: its totals, and the store's row that has its Gaussians.

update_seq and row are -1 where the agent has no update of a voxel.
"""
NO_SCORES: Scores = np.zeros(0, SCORES)
VOXEL_BYTES, TILE_BYTES = 50, 900
"""What a voxel, and each map's tile with voxels, take in memory here and in the change log; measured."""
VOXEL_UNITS = 2
"""The size of a voxel beside its Gaussians, in Gaussians."""


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
            self.kappa_sum + _exact_sum(added["kappa_sums"]) - _exact_sum(removed["kappa_sums"]),
            max(self.highest_update_seq, int(added["update_seqs"].max(initial=0))),
        )


def _exact_sum(values: UInt64[ndarray, " k"]) -> int:
    """Return a sum that cannot wrap around."""
    return sum(values.tolist())


_PACKED = np.dtype([("offsets", "u2"), *_COLUMNS])
_NO_TABLE: Table = np.zeros(0, _PACKED)
_MISSING = np.zeros((), _PACKED)
_MISSING["update_seqs"] = _MISSING["rows"] = -1
_MODULUS = 1 << 64
ReadVoxels = Callable[[str, Int64[ndarray, " k"]], Sequence[EncodedVoxels]]
"""Returns an agent's stored updates of some voxels in parts, each with ascending keys."""


@dataclass(slots=True, eq=False)
class MapTile:
    """A map's part in a tile. written, used: the size of its rows, and of its voxels in them, in Gaussians."""

    table: Table = field(default_factory=lambda: _NO_TABLE)
    rows: array[int] = field(default_factory=lambda: array("q"))
    written: int = 0
    used: int = 0
    digest: int = 0


@dataclass(slots=True, eq=False)
class _Map:
    tiles: dict[int, MapTile] = field(default_factory=dict)
    totals: AgentTotals = field(default_factory=AgentTotals)


_NO_MAP = _Map()


class ScoreIndex:
    """Totals by map and voxel, 30 bytes each. Not thread-safe; the store holds a lock."""

    def __init__(self) -> None:
        self._maps: dict[str, _Map] = {}
        self.agents: tuple[str, ...] = ()
        """The names of the maps with rows, sorted."""

    def totals(self, name: str) -> AgentTotals:
        """Return the sums over a map's rows; zero for an unknown one."""
        return self._maps.get(name, _NO_MAP).totals

    def tiles(self, name: str) -> dict[int, MapTile]:
        """Return the tiles of a map; empty for an unknown one."""
        return self._maps.get(name, _NO_MAP).tiles

    def tile(self, name: str, tile: int) -> MapTile:
        """Return a tile of a map; both exist from then on."""
        if name not in self._maps:
            self._maps[name] = _Map()
            self.agents = tuple(sorted(self._maps))
        tiles = self._maps[name].tiles
        if tile not in tiles:
            tiles[tile] = MapTile()
        return tiles[tile]

    def memory_bytes(self, names: Iterable[str], name: str, added: Int64[ndarray, " k"]) -> int:
        """Return the memory that these maps take in the index and the change log, with voxels added to one, at most."""
        tiles = len(set(tiles_of(added).tolist()) - self.tiles(name).keys())
        maps = [self._maps[own] for own in names]
        voxels = sum(own.totals.voxels for own in maps)
        return VOXEL_BYTES * (len(added) + voxels) + TILE_BYTES * (tiles + sum(len(own.tiles) for own in maps))

    def digests(self, name: str) -> TileDigests:
        """Return the digests of a map's rows, which are kept with each change; empty for an unknown one."""
        tiles = self.tiles(name)
        names = np.fromiter(tiles, np.int64, len(tiles))
        hashes = np.fromiter((tile.digest for tile in tiles.values()), np.uint64, len(tiles))
        order = np.argsort(names)
        return TileDigests(names[order], hashes[order])

    def scores_of(self, name: str, keys: Int64[ndarray, " k"]) -> Scores:
        """Return the map's totals on these voxels, in their order."""
        found = self._stored(name, keys)
        return _scores(keys, found)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return the totals of all maps on these voxels, or on all."""
        wanted = None if keys is None else np.unique(keys)
        tiles = set(tiles_of(wanted).tolist()) if wanted is not None else None
        present = [
            index for index, name in enumerate(self.agents) if tiles is None or not tiles.isdisjoint(self.tiles(name))
        ]
        parts = [self.sorted_scores(self.agents[index], wanted) for index in present]
        agent_index = np.repeat(np.array(present, np.int32), [len(part) for part in parts])
        return VoxelScoreTable(self.agents, agent_index, join_elements([NO_SCORES, *parts]))

    def sorted_scores(self, name: str, keys: Int64[ndarray, " k"] | None = None) -> Scores:
        """Return the map's totals on those of these voxels (ascending keys) that it has, or on all."""
        if keys is not None:
            found = self._stored(name, keys)
            present = found["rows"] >= 0
            return _scores(keys[present], found[present])
        tiles = self.tiles(name)
        tables = [tile.table for tile in tiles.values()]
        scores = _scores(keys_of(list(tiles), tables), joined(tables, _PACKED))
        return scores.take(np.argsort(scores["keys"]))

    def put(self, name: str, scores: Scores) -> None:
        """Replace the map's totals on the voxels of the scores."""
        scores = scores.take(np.argsort(scores["keys"], kind="stable"))
        keys, added = np.ascontiguousarray(scores["keys"]), np.empty(len(scores), _PACKED)
        added["offsets"] = offsets_of(keys)
        for column, _ in _COLUMNS:
            added[column] = scores[column]
        before = self._stored(name, keys)
        self._replace(name, keys, before, added)

    def remove_tiles(self, name: str, tiles: Iterable[int]) -> Int64[ndarray, " v"]:
        """Delete the map's rows in these tiles; returns the keys of their voxels. A map without tiles is unknown."""
        own = self._maps.get(name, _NO_MAP)
        removed = {tile: own.tiles.pop(tile).table for tile in tiles}
        own.totals = own.totals.replace_part(joined(removed.values(), _PACKED), _NO_TABLE)
        if name in self._maps and not own.tiles:
            del self._maps[name]
            self.agents = tuple(sorted(self._maps))
        return np.sort(keys_of(list(removed), list(removed.values())))

    def rename(self, name: str, other: str) -> None:
        """Give a map another name, if it exists."""
        if name in self._maps:
            self._maps[other] = self._maps.pop(name)
            self.agents = tuple(sorted(self._maps))

    def _stored(self, name: str, keys: Int64[ndarray, " k"]) -> Table:
        """Return the map's elements on these voxels, in their order; _MISSING where it has none."""
        found, offsets, tiles = np.full(len(keys), _MISSING), offsets_of(keys), self.tiles(name)
        for tile, places in by_tile(keys) if tiles else ():
            own = tiles.get(tile)
            if own is not None:
                at = find(own.table, offsets[places])
                found[places[at >= 0]] = own.table.take(at[at >= 0])
        return found

    def _replace(self, name: str, keys: Int64[ndarray, " k"], before: Table, added: Table) -> None:
        """Put these elements in the place of those from before, and follow with the sums of map and tiles."""
        was_there = before["rows"] >= 0
        sizes = added["counts"].astype(np.int64) + VOXEL_UNITS
        sizes -= np.where(was_there, before["counts"].astype(np.int64) + VOXEL_UNITS, 0)
        hashes = hash_columns(keys, added["update_seqs"])
        hashes -= np.where(was_there, hash_columns(keys, before["update_seqs"]), np.uint64(0))
        for number, places in by_tile(keys):
            tile, part = self.tile(name, number), added.take(places)
            tile.table = replaced(tile.table, find(tile.table, part["offsets"]) if len(tile.table) else places, part)
            tile.used += int(sizes[places].sum())
            tile.digest = (tile.digest + int(hashes[places].sum())) % _MODULUS
        own = self._maps[name]
        own.totals = own.totals.replace_part(before, added)


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
