"""The rows of a store: a log of voxel updates, which of them are in use, and when to write them anew.

A message adds one row for each tile with voxels that it replaces; no row ever changes. The index names the row that has
a voxel's latest update. A message to a tile of which more than half is outdated writes the agent's whole tile as one
row, and the next transaction deletes the earlier ones. So each transaction deletes only rows that the index no longer
named before it, and a reader that has asked the index finds its rows, or asks again. After a crash the update with the
highest (update_seq, row) is a voxel's latest.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import google_crc32c
import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.codec.encoded_voxels import VOXELS, EncodedSubset, EncodedVoxels, join_elements
from gausslite.domain.errors import GaussLiteError, InvalidInputError, StorageError
from gausslite.domain.voxels import VoxelBatch, empty_batch, merge_batches, tile_of, tiles_of
from gausslite.fusion.epochs import Epochs
from gausslite.fusion.score_index import ROWS, SCORES, VOXEL_UNITS, ScoreIndex, Scores, newer_voxels

UpdateRow = tuple[int, str, int, bytes]
"""number, label of the map (see Epochs), checksum, voxels."""
ReadRows = Callable[[Sequence[int]], Mapping[int, bytes]]
"""Returns the voxels of those of these rows that exist. Raises StorageError."""
Places = tuple[Int64[ndarray, " _"], Int64[ndarray, " _"]]
"""Ascending keys of voxels, and the row of each."""
SLOT_BITS = 48
"""The bits of a row's number from here on are the slot of its voxels."""
SlotsOf = Callable[[Int64[ndarray, " n"]], Int64[ndarray, " n"]]
"""Returns the slot of each voxel; those of a tile have the same."""
_SPARE_UNITS = 1 << 8
"""About 5 kB of Gaussians, which may be outdated in each tile."""
_REWRITTEN = 4
"""How many times its own size a message may write anew; at 2, it would remove no more than it adds."""
_LOADED_VOXELS = 1 << 16
"""Those of the rows that are read at a time."""
_TileRow = tuple[int, int, EncodedVoxels]
"""tile, number, voxels."""


@dataclass(frozen=True, slots=True, eq=False)
class PutOutcome:
    """The voxels of a message that were stored, and those that were stale; keys in ascending order."""

    accepted: Int64[ndarray, " a"]  # newer than what was stored
    stale: Int64[ndarray, " s"]


@dataclass(slots=True)
class LogChange:
    """What one transaction deletes and writes. The log has it only after `apply`."""

    deleted: list[int] = field(default_factory=list)  # row numbers
    rows: list[UpdateRow] = field(default_factory=list)  # to insert
    puts: list[tuple[str, list[_TileRow], dict[int, list[int]]]] = field(default_factory=list)
    """Map, its new rows, and the rows of the tiles that were written anew."""
    outcomes: list[PutOutcome] = field(default_factory=list)


class UpdateLog:
    """Owns the index of the rows. Not thread-safe: one thread plans and applies, readers of the index hold its lock."""

    def __init__(self, slots_of: SlotsOf = np.zeros_like) -> None:
        self.index, self.epochs = ScoreIndex(), Epochs()
        self._slots_of = slots_of
        # deleted by the next transaction
        self._outdated: list[int] = []
        # the highest number of a row, without its slot
        self._last = 0

    def load(self, rows: Iterable[UpdateRow]) -> None:
        """Read all rows of a store, which ascend in each slot; they are intact."""
        parts: list[tuple[str, int, EncodedVoxels]] = []
        size = 0
        for number, label, _, data in rows:
            # the index keeps no part of a row
            parts.append((self.epochs.name_of(label), number, EncodedVoxels.from_row(data)))
            self._last = max(self._last, number & ((1 << SLOT_BITS) - 1))
            size += len(parts[-1][2])
            if size >= _LOADED_VOXELS:
                self._load(parts)
                parts, size = [], 0
        self._load(parts)

    def _load(self, parts: Sequence[tuple[str, int, EncodedVoxels]]) -> None:
        for name in {name for name, _, _ in parts}:
            own = [(tile_of(int(voxels.keys[0])), number, voxels) for owner, number, voxels in parts if owner == name]
            self._add_rows(name, own)
            scores = _scores_of(own)
            order = np.lexsort((scores["rows"], scores["update_seqs"], scores["keys"]))
            keys = scores["keys"][order]
            latest = scores.take(order[np.append(keys[1:] != keys[:-1], True)[: len(keys)]])
            # a row is newer than those that were read before
            stored = self.index.scores_of(name, latest["keys"])["update_seqs"]
            self.index.put(name, latest[latest["update_seqs"] >= stored])

    def plan(self, updates: Sequence[EncodedSubset], read: ReadRows) -> LogChange:
        """Return how to store messages of different agents, each completely. Raises StorageError."""
        change = LogChange(deleted=list(self._outdated))
        for update in updates:
            newer = newer_voxels(self.index, update, lambda name, keys: self._stored(name, keys, read))
            keys = update.voxels.keys
            change.outcomes.append(PutOutcome(keys[newer], keys[~newer]))
            accepted = update.voxels if newer.all() else update.voxels.take(np.flatnonzero(newer))
            if len(accepted):
                self._add(change, update.agent_id, accepted, read)
        return change

    def apply(self, change: LogChange) -> None:
        """Record a change whose transaction is committed."""
        self._outdated = []
        for name, rows, outdated in change.puts:
            self._add_rows(name, rows, outdated)
            self.index.put(name, _scores_of(rows))
            self._outdated += itertools.chain.from_iterable(outdated.values())

    def removable(self, name: str, at_most: int) -> tuple[int, list[int]]:
        """Return where a map's last tiles begin, with about so many voxels, and what to delete with them.

        These are their rows, and outdated ones; nothing of an unknown map.
        """
        place, numbers = self.index.last_tiles(name, at_most)
        return place, [*numbers, *self._outdated] if numbers else []

    def remove(self, name: str, place: int) -> Int64[ndarray, " v"]:
        """Record that what is `removable` is deleted; returns the keys of the voxels, ascending."""
        if name in self.index.agents:
            self._outdated = []
        return self.index.remove_from(name, place)

    def places(self, agent_id: str, keys: Int64[ndarray, " k"] | None) -> Places:
        """Return where the agent's updates of these voxels, or all, are."""
        scores = self.index.sorted_scores(agent_id, None if keys is None else np.unique(keys))
        return np.ascontiguousarray(scores["keys"]), np.ascontiguousarray(scores["rows"])

    def _stored(self, agent_id: str, keys: Int64[ndarray, " k"], read: ReadRows) -> list[EncodedVoxels]:
        keys, rows = self.places(agent_id, keys)
        return _voxels_of(keys, rows, read(np.unique(rows).tolist()))

    def _add(self, change: LogChange, name: str, accepted: EncodedVoxels, read: ReadRows) -> None:
        """Add a row for each tile of these voxels, with all others of the map's tile if that is outdated."""
        label, rows = self.epochs.label_of(name), list[_TileRow]()
        at_most = _SPARE_UNITS + _REWRITTEN * _size(accepted)
        outdated = self.index.outdated_rows(name, np.unique(tiles_of(accepted.keys)), _SPARE_UNITS, at_most)
        parts = {accepted.size_m: [accepted]}
        for others in self._others(name, accepted.keys, list(itertools.chain(*outdated.values())), read):
            parts.setdefault(others.size_m, []).append(others)
        for same_size in parts.values():
            voxels = _in_order(EncodedVoxels.concatenate(same_size))
            tiles = np.unique(tiles_of(voxels.keys))
            slots = (self._slots_of(tiles) << SLOT_BITS).tolist()
            for tile, slot, part in zip(tiles.tolist(), slots, voxels.by_tile(), strict=True):
                self._last += 1
                number, data = slot + self._last, part.to_row()
                change.rows.append((number, label, data_checksum(label, number, data), data))
                rows.append((tile, number, part))
        change.puts.append((name, rows, outdated))

    def _others(
        self, name: str, keys: Int64[ndarray, " k"], numbers: Sequence[int], read: ReadRows
    ) -> Iterator[EncodedVoxels]:
        """Yield what these rows have of the map's latest updates, without these voxels."""
        rows = [(number, EncodedVoxels.from_row(data)) for number, data in read(numbers).items()] if numbers else []
        if rows:
            scores = _scores_of([(0, *row) for row in rows])
            is_used = self.index.scores_of(name, scores["keys"])["rows"] == scores["rows"]
            is_used &= ~np.isin(scores["keys"], keys)
            ends = np.cumsum([len(voxels) for _, voxels in rows])
            for (_, voxels), own in zip(rows, np.split(is_used, ends[:-1]), strict=True):
                if own.any():
                    yield voxels.take(np.flatnonzero(own))

    def _add_rows(self, name: str, rows: Sequence[_TileRow], emptied: Collection[int] = ()) -> None:
        added = [(tile, number, _size(voxels)) for tile, number, voxels in rows]
        self.index.add_rows(name, np.array(added, ROWS), emptied)


def require_storable(update: EncodedSubset) -> None:
    """Raise InvalidInputError if a number of the message does not fit the store's signed 64-bit columns."""
    largest_sum = int(update.voxels.voxels["kappa_sums"].max(initial=0))
    limit = int(np.iinfo(np.int64).max)
    numbers = (("update_seq", update.update_seq), ("message_seq", update.message_seq), ("kappa_sum", largest_sum))
    for name, value in numbers:
        if value > limit:
            raise InvalidInputError(f"subset {name}: expected at most {limit}, got {value}")


def is_intact(row: UpdateRow) -> bool:
    """Return whether a row has its checksum."""
    number, agent_id, checksum, data = row
    return data_checksum(agent_id, number, data) == checksum


def data_checksum(owner: str, name: str | int, data: bytes) -> int:
    """Return the CRC32C of a row, a keyframe or a record."""
    return int(google_crc32c.extend(google_crc32c.value(f"{owner}\0{name}".encode()), data))


def batch_of(keys: Int64[ndarray, " k"], rows: Int64[ndarray, " k"], data: Mapping[int, bytes]) -> VoxelBatch:
    """Return the voxels with these ascending keys, each from its row. Raises StorageError for damaged rows."""
    try:
        batches = [voxels.batch() for voxels in _voxels_of(keys, rows, data)]
    except GaussLiteError as error:
        raise StorageError(f"stored voxel: {error}; the store is damaged") from error
    return merge_batches(*batches) if len(batches) > 1 else batches[0] if batches else empty_batch()


def _voxels_of(
    keys: Int64[ndarray, " k"], rows: Int64[ndarray, " k"], data: Mapping[int, bytes]
) -> list[EncodedVoxels]:
    """Return the voxels with these keys, each from its row: a part for each size_m, with ascending keys."""
    parts: dict[float, list[EncodedVoxels]] = {}
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    for start, stop in itertools.pairwise([*starts.tolist(), len(rows)]):
        voxels = EncodedVoxels.from_row(data[int(rows[order[start]])])
        places = np.searchsorted(voxels.keys, keys[order[start:stop]])
        parts.setdefault(voxels.size_m, []).append(voxels if len(places) == len(voxels) else voxels.take(places))
    return [_in_order(EncodedVoxels.concatenate(own)) for own in parts.values()]


def _in_order(voxels: EncodedVoxels) -> EncodedVoxels:
    keys = voxels.keys
    return voxels if (keys[1:] > keys[:-1]).all() else voxels.take(np.argsort(keys))


def _size(voxels: EncodedVoxels) -> int:
    return len(voxels.gaussians) + VOXEL_UNITS * len(voxels)


def _scores_of(rows: Sequence[_TileRow]) -> Scores:
    """Return the totals of the voxels of these numbered rows, in order."""
    table = join_elements([voxels.voxels for _, _, voxels in rows])
    scores = np.empty(len(table), SCORES)
    for name in VOXELS.names or ():
        scores[name] = table[name]
    numbers = np.array([number for _, number, _ in rows], np.int64)
    scores["rows"] = np.repeat(numbers, [len(voxels) for _, _, voxels in rows])
    return scores
