"""The rows of a store: a log of voxel updates, which of them are in use, and when to write them anew.

A message adds one row for each tile with voxels that it replaces; no row ever changes. The index names the row that has
a voxel's latest update. Rows are numbered in segments. If more than half of all rows is outdated, the segment with the
smallest part in use is emptied: its voxels in use move to new rows, and the next transaction deletes its rows. So each
transaction deletes only rows that the index no longer named before it, and a reader that has asked the index finds its
rows, or asks again. After a crash the update with the highest (update_seq, row) is a voxel's latest.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from threading import RLock
from typing import Any

import google_crc32c
import numpy as np
from jaxtyping import Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.stored_voxels import StoredSubset, StoredVoxels, join_elements
from gausslite.domain.errors import GaussLiteError, StorageError
from gausslite.domain.voxels import VoxelBatch, empty_batch, merge_batches
from gausslite.fusion.score_index import ScoreIndex, newer_voxels
from gausslite.fusion.store_values import PutOutcome, StoredScores

UpdateRow = tuple[int, str, int, bytes]
"""number, agent_id, checksum, voxels."""
ReadRows = Callable[[Sequence[int]], Mapping[int, bytes]]
"""Returns the voxels of those of these rows that exist. Raises StorageError."""
Places = tuple[Int64[ndarray, " _"], Int64[ndarray, " _"]]
"""Ascending keys of voxels, and the row of each."""
SEGMENT_BITS = 16
"""The other bits of a row's number name its segment."""
SLOT_BITS = 48
"""The bits from here on are the slot of the row's voxels; a segment has rows of one slot."""
SlotsOf = Callable[[Int64[ndarray, " n"]], Int64[ndarray, " n"]]
"""Returns the slot of each voxel; those of a tile have the same."""
_SEGMENT_UNITS = 1 << 14
"""About 350 kB of Gaussians."""
_SPARE_SEGMENTS = 4
_VOXEL_UNITS = 2
"""The size of a voxel beside its Gaussians, in Gaussians."""
_READ_ATTEMPTS = 20


@dataclass(slots=True)
class _Segment:
    """Rows whose numbers have the same high bits; sizes in units of one Gaussian."""

    rows: set[int] = field(default_factory=set)
    total: int = 0
    used: int = 0


@dataclass(slots=True)
class LogChange:
    """What one transaction deletes and writes. The log has it only after `apply`."""

    deleted: list[int] = field(default_factory=list)
    rows: list[UpdateRow] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    puts: list[tuple[str, Int64[ndarray, " _"], StoredScores]] = field(default_factory=list)
    outcomes: list[PutOutcome] = field(default_factory=list)
    emptied: list[int] = field(default_factory=list)


class UpdateLog:
    """Owns the index of the rows. Not thread-safe: one thread plans and applies, readers of the index hold its lock."""

    def __init__(self, slots_of: SlotsOf = np.zeros_like) -> None:
        self.index = ScoreIndex()
        self._slots_of = slots_of
        self._segments: dict[int, _Segment] = {}
        # (agent, size) of every row, those of emptied segments included
        self._rows: dict[int, tuple[str, int]] = {}
        # deleted by the next transaction
        self._outdated: list[int] = []
        self._total = self._used = 0
        # of each slot: the last row's number, and the size of its segment
        self._last: dict[int, tuple[int, int]] = {}

    def load(self, rows: Iterable[UpdateRow]) -> None:
        """Read all rows of a store; they are intact."""
        tables: dict[str, list[tuple[int, NDArray[Any]]]] = {}
        for number, agent_id, _, data in rows:
            voxels = StoredVoxels.from_row(data)
            self._add_row(number, agent_id, _size(voxels))
            tables.setdefault(agent_id, []).append((number, voxels.voxels.copy()))
        for agent_id, parts in tables.items():
            table = np.concatenate([own for _, own in parts])
            numbers = np.repeat(np.array([number for number, _ in parts], np.int64), [len(own) for _, own in parts])
            order = np.lexsort((numbers, table["update_seqs"], table["keys"]))
            keys = table["keys"][order]
            latest = order[np.append(keys[1:] != keys[:-1], True)[: len(keys)]]
            self._put([(agent_id, *_scores(table[latest], numbers[latest]))])
        # numbers beyond all others, in segments of their own
        self._last = {number >> SLOT_BITS: (number, _SEGMENT_UNITS) for number in sorted(self._rows)}

    def plan(self, updates: Sequence[StoredSubset], read: ReadRows) -> LogChange:
        """Return how to store messages of different agents, each completely. Raises StorageError."""
        change = LogChange(deleted=list(self._outdated))
        self._empty_segments(change, read)
        for update in updates:
            newer = newer_voxels(self.index, update, lambda name, keys: self._stored(name, keys, read))
            keys = update.voxels.keys
            change.outcomes.append(PutOutcome(keys[newer], keys[~newer]))
            accepted = update.voxels if newer.all() else update.voxels.take(np.flatnonzero(newer))
            self._add(change, update.agent_id, accepted)
        return change

    def apply(self, change: LogChange) -> None:
        """Record a change whose transaction is committed."""
        for number in change.deleted:
            del self._rows[number]
        for (number, agent_id, _, _), size in zip(change.rows, change.sizes, strict=True):
            self._add_row(number, agent_id, size)
        self._put(change.puts)
        self._outdated = []
        for name in change.emptied:
            segment = self._segments.pop(name)
            self._total -= segment.total
            self._outdated += sorted(segment.rows)

    def rows_of(self, agent_id: str) -> list[int]:
        """Return the numbers of all rows of an agent, outdated ones too."""
        return [number for number, (name, _) in self._rows.items() if name == agent_id]

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Record that the rows of an agent are deleted; returns the keys of its voxels, ascending."""
        keys, _, _, counts, rows = self.index.columns(agent_id, None)
        self._count_used(rows, counts, -1)
        for number in self.rows_of(agent_id):
            _, size = self._rows.pop(number)
            segment = self._segments.get(number >> SEGMENT_BITS)
            if segment is not None:
                segment.rows.remove(number)
                segment.total -= size
                self._total -= size
        self._segments = {name: segment for name, segment in self._segments.items() if segment.rows}
        self._outdated = [number for number in self._outdated if number in self._rows]
        self.index.remove_agent(agent_id)
        return keys

    def places(self, agent_id: str, keys: Int64[ndarray, " k"] | None) -> Places:
        """Return where the agent's updates of these voxels, or all, are."""
        columns = self.index.columns(agent_id, None if keys is None else np.unique(keys))
        return columns[0], columns[4]

    def _stored(self, agent_id: str, keys: Int64[ndarray, " k"], read: ReadRows) -> list[StoredVoxels]:
        keys, rows = self.places(agent_id, keys)
        return _voxels_of(keys, rows, read(np.unique(rows).tolist()))

    def _add(self, change: LogChange, agent_id: str, voxels: StoredVoxels) -> None:
        """Add rows with these voxels, whose keys ascend."""
        parts = voxels.by_tile()
        if not parts:
            return
        numbers = []
        slots = self._slots_of(np.array([part.voxels["keys"][0] for part in parts], np.int64)).tolist()
        for slot, part in zip(slots, parts, strict=True):
            size, data = _size(part), part.to_row()
            numbers.append(self._next_number(slot, size))
            change.rows.append((numbers[-1], agent_id, data_checksum(agent_id, numbers[-1], data), data))
            change.sizes.append(size)
        table = join_elements([part.voxels for part in parts])
        rows = np.repeat(np.array(numbers, np.int64), [len(part) for part in parts])
        change.puts.append((agent_id, *_scores(table, rows)))

    def _empty_segments(self, change: LogChange, read: ReadRows) -> None:
        """Move the voxels in use out of the segments with the smallest part in use, while too much is outdated."""
        total, used = self._total, self._used
        current = {number >> SEGMENT_BITS for number, _ in self._last.values()}
        while total - used > max(used, _SPARE_SEGMENTS * _SEGMENT_UNITS):
            others = (name for name in self._segments if name not in change.emptied and name not in current)
            name = min(others, key=lambda name: self._segments[name].used / self._segments[name].total, default=None)
            if name is None:
                return
            segment = self._segments[name]
            if segment.used:
                self._move(change, read(sorted(segment.rows)))
            change.emptied.append(name)
            total -= segment.total - segment.used

    def _move(self, change: LogChange, rows: Mapping[int, bytes]) -> None:
        parts: dict[tuple[str, float], list[StoredVoxels]] = {}
        for number, data in rows.items():
            agent_id, voxels = self._rows[number][0], StoredVoxels.from_row(data)
            used = np.flatnonzero(self.index.stored(agent_id, voxels.keys).rows == number)
            if len(used):
                parts.setdefault((agent_id, voxels.size_m), []).append(voxels.take(used))
        for (agent_id, _), own in parts.items():
            voxels = StoredVoxels.concatenate(own)
            self._add(change, agent_id, voxels.take(np.argsort(voxels.keys)))

    def _next_number(self, slot: int, size: int) -> int:
        number, filled = self._last.get(slot, (slot << SLOT_BITS, 0))
        number += 1
        if filled >= _SEGMENT_UNITS:
            number, filled = ((number >> SEGMENT_BITS) + 1) << SEGMENT_BITS, 0
        self._last[slot] = number, filled + size
        return number

    def _add_row(self, number: int, agent_id: str, size: int) -> None:
        segment = self._segments.setdefault(number >> SEGMENT_BITS, _Segment())
        segment.rows.add(number)
        segment.total += size
        self._total += size
        self._rows[number] = agent_id, size

    def _put(self, puts: Sequence[tuple[str, Int64[ndarray, " _"], StoredScores]]) -> None:
        if not puts:
            return
        before = [self.index.put(agent_id, keys, scores) for agent_id, keys, scores in puts]
        for scores, sign in ((before, -1), ([put[2] for put in puts], 1)):
            rows, counts = (np.concatenate([getattr(own, name) for own in scores]) for name in ("rows", "counts"))
            self._count_used(rows[rows >= 0], counts[rows >= 0], sign)

    def _count_used(self, rows: Int64[ndarray, " k"], counts: NDArray[Any], sign: int) -> None:
        names, places = np.unique(rows >> SEGMENT_BITS, return_inverse=True)
        sizes = np.bincount(places, counts + float(_VOXEL_UNITS), len(names)).astype(np.int64) * sign
        for name, size in zip(names.tolist(), sizes.tolist(), strict=True):
            self._segments[name].used += size
            self._used += size


def read_batches(
    log: UpdateLog,
    index_lock: RLock,
    read: ReadRows,
    keys: Int64[ndarray, " k"] | None,
    agents: Sequence[str] | None = None,
) -> dict[str, VoxelBatch]:
    """Return the updates of these agents, or of all, on these voxels, or on all. Raises StorageError for damaged rows.

    index_lock: held while the log's index is read.
    """
    for _ in range(_READ_ATTEMPTS):
        with index_lock:
            names = log.index.agents if agents is None else agents
            places = {agent_id: log.places(agent_id, keys) for agent_id in names}
        numbers = np.unique(np.concatenate([np.zeros(0, np.int64), *(rows for _, rows in places.values())]))
        data = read(numbers.tolist()) if len(numbers) else {}
        # rows may have been moved after the index was asked
        if len(data) == len(numbers):
            return {agent_id: _batch_of(keys, rows, data) for agent_id, (keys, rows) in places.items()}
    raise StorageError(f"store: expected rows that the index names, got {len(data)} of {len(numbers)}; try again")


def require_intact(rows: Iterable[UpdateRow], damaged: Callable[[str], StorageError]) -> Iterator[UpdateRow]:
    """Yield the rows. Raises the StorageError that `damaged` makes of the name of a damaged one."""
    for row in rows:
        if not is_intact(row):
            raise damaged(f"row {row[0]} of agent {row[1]!r}")
        yield row


def is_intact(row: UpdateRow) -> bool:
    """Return whether a row has its checksum."""
    number, agent_id, checksum, data = row
    return data_checksum(agent_id, number, data) == checksum


def data_checksum(owner: str, name: str | int, data: bytes) -> int:
    """Return the CRC32C of a row, a keyframe or a record."""
    return int(google_crc32c.extend(google_crc32c.value(f"{owner}\0{name}".encode()), data))


def _batch_of(keys: Int64[ndarray, " k"], rows: Int64[ndarray, " k"], data: Mapping[int, bytes]) -> VoxelBatch:
    """Return the voxels with these ascending keys, each from its row."""
    try:
        batches = [voxels.batch() for voxels in _voxels_of(keys, rows, data)]
    except GaussLiteError as error:
        raise StorageError(f"stored voxel: {error}; the store is damaged") from error
    return merge_batches(*batches) if len(batches) > 1 else batches[0] if batches else empty_batch()


def _voxels_of(keys: Int64[ndarray, " k"], rows: Int64[ndarray, " k"], data: Mapping[int, bytes]) -> list[StoredVoxels]:
    """Return the voxels with these keys, each from its row: a part for each size_m, with ascending keys."""
    parts: dict[float, list[StoredVoxels]] = {}
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    for start, stop in itertools.pairwise([*starts.tolist(), len(rows)]):
        voxels = StoredVoxels.from_row(data[int(rows[order[start]])])
        places = np.searchsorted(voxels.keys, keys[order[start:stop]])
        parts.setdefault(voxels.size_m, []).append(voxels if len(places) == len(voxels) else voxels.take(places))
    return [_in_order(StoredVoxels.concatenate(own)) for own in parts.values()]


def _in_order(voxels: StoredVoxels) -> StoredVoxels:
    keys = voxels.keys
    return voxels if (keys[1:] > keys[:-1]).all() else voxels.take(np.argsort(keys))


def _size(voxels: StoredVoxels) -> int:
    return len(voxels.gaussians) + _VOXEL_UNITS * len(voxels)


def _scores(table: NDArray[Any], rows: Int64[ndarray, " k"]) -> tuple[Int64[ndarray, " k"], StoredScores]:
    """Return the keys of voxels and their totals, of elements of VOXELS."""
    keys, sums, counts = (np.ascontiguousarray(table[name]) for name in ("keys", "kappa_sums", "counts"))
    return keys, StoredScores(table["update_seqs"].astype(np.int64), sums, counts, rows)
