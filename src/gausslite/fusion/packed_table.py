"""A table of an element for each voxel, packed in sorted arrays, so that a voxel costs few bytes and no object.

New voxels come into a small run beside the large ones. Runs are merged so that each is several times larger than the
next (P. O'Neil et al., "The log-structured merge-tree", Acta Informatica 33, 1996): a message costs its voxels,
wherever they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.voxels import BITS_PER_AXIS, TILE_VOXELS, gather_rows

Table = NDArray[Any]
_Run = tuple[Int64[ndarray, " _"], Table]
"""Ascending places and their elements."""
_LOW_BITS = TILE_VOXELS.bit_length() - 1
_TILE_PLACES = TILE_VOXELS**3
_LOW, _HIGH = TILE_VOXELS - 1, (1 << BITS_PER_AXIS) - TILE_VOXELS
_STEP = BITS_PER_AXIS - _LOW_BITS
_RATIO, _SMALL_RUN = 4, 1 << 10


def places_of(keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the place of each voxel in the order by tile and key; that of a tile is its first voxel's."""
    low = keys & (_LOW << 2 * BITS_PER_AXIS | _LOW << BITS_PER_AXIS | _LOW)
    places = (low | low >> _STEP | low >> 2 * _STEP) & _TILE_PLACES - 1
    for axis in range(3):
        places |= (keys & _HIGH << axis * BITS_PER_AXIS) << (2 - axis) * _LOW_BITS
    return places


def keys_of(places: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the key of the voxel at each place."""
    keys = np.zeros(len(places), np.int64)
    for axis in range(3):
        keys |= places >> (2 - axis) * _LOW_BITS & _HIGH << axis * BITS_PER_AXIS
        keys |= (places >> axis * _LOW_BITS & _LOW) << axis * BITS_PER_AXIS
    return keys


def tiles_at(places: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the place of each voxel's tile."""
    return places & -_TILE_PLACES


class PackedTable:
    """Elements by place. Those with the first field of `absent` are not in the table. Not thread-safe."""

    def __init__(self, absent: Table) -> None:
        self._absent = absent
        self._first = (absent.dtype.names or ("",))[0]
        # absent elements in them leave when they are many
        self._runs: list[_Run] = []
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def copy(self) -> PackedTable:
        """Return an equal table that changes on its own."""
        other = PackedTable(self._absent)
        other._runs, other._size = [(places, elements.copy()) for places, elements in self._runs], self._size
        return other

    def is_present(self, elements: Table) -> Bool[ndarray, " n"]:
        """Return which of these elements are not absent ones."""
        present: Bool[ndarray, " n"] = elements[self._first] != self._absent[self._first]
        return present

    def get(self, places: Int64[ndarray, " n"]) -> Table:
        """Return the elements at these places, in their order."""
        found = np.full(len(places), self._absent)
        for _, elements, here, at in self._find(places):
            _raw(found)[here] = _raw(elements).take(at)
        return found

    def parts(self, places: Int64[ndarray, " n"] | None) -> Sequence[_Run]:
        """Return the elements at these places, or all, in parts; absent ones may be among them."""
        if places is None:
            return self._runs
        return [(own[at], elements.take(at)) for own, elements, _, at in self._find(places)]

    def put(self, places: Int64[ndarray, " n"], elements: Table) -> Table:
        """Replace the elements at these places, all different, and return those before; absent ones leave the table."""
        is_new, before = self.is_present(elements), np.full(len(places), self._absent)
        self._size += int(np.count_nonzero(is_new))
        for _, own, here, at in self._find(places):
            _raw(before)[here] = _raw(own).take(at)
            _raw(own)[at] = _raw(elements).take(here)
            is_new[here] = False
        self._size -= int(np.count_nonzero(self.is_present(before)))
        new = np.flatnonzero(is_new)
        if len(new):
            new = new[np.argsort(places[new])]
            self._runs.append((places[new], elements.take(new)))
        while len(self._runs) > 1 and len(self._runs[-2][0]) < max(_SMALL_RUN, _RATIO * len(self._runs[-1][0])):
            self._runs[-2:] = [_merged(*self._runs[-2:])]
        if sum(len(own) for own, _ in self._runs) > 2 * self._size + _SMALL_RUN:
            self._runs = [self.select()]
        return before

    def select(self, chosen: Callable[[Table], Bool[ndarray, " n"]] | None = None) -> _Run:
        """Return the places, ascending, and the elements for which `chosen` is true, or all; they may be no copies."""
        return self._joined([own if chosen is None else _taken(own, chosen(own[1])) for own in self._runs])

    def in_tiles(self, tiles: Int64[ndarray, " t"]) -> _Run:
        """Return the places, ascending, and the elements in the tiles at these places."""
        runs = []
        for own, elements in self._runs:
            starts = own.searchsorted(tiles)
            stops = own.searchsorted(tiles | _TILE_PLACES - 1, side="right")
            at = gather_rows(starts, stops - starts)
            runs.append((own[at], elements.take(at)))
        return self._joined(runs)

    def last(self, count: int) -> _Run:
        """Return the last places, at most so many, and their elements; they are no copies."""
        if len(self._runs) != 1 or len(self._runs[0][0]) > self._size:
            self._runs = [self.select()]
        own, elements = self._runs[0]
        start = max(len(own) - count, 0)
        return own[start:], elements[start:]

    def remove_from(self, place: int) -> _Run:
        """Delete this place and all after it; returns them with their elements."""
        own, elements = self.last(self._size)
        at = int(own.searchsorted(place))
        self._size, rest = at, (own[:at], elements[:at])
        base = own if own.base is None else own.base
        # not for each call, as it copies what is left
        self._runs = [rest if 2 * at > len(base) else (rest[0].copy(), rest[1].copy())]
        return own[at:], elements[at:]

    def _find(self, places: Int64[ndarray, " n"]) -> Iterator[tuple[ndarray, Table, ndarray, ndarray]]:
        """Yield each run with the indices of these places that it has, and where it has them."""
        for own, elements in self._runs if len(places) else ():
            at = own.searchsorted(places)
            here = np.flatnonzero(own.take(at, mode="clip") == places) if len(own) else at[:0]
            if len(here):
                yield own, elements, here, at[here]

    def _joined(self, runs: Sequence[_Run]) -> _Run:
        """Return all runs as one, without absent elements."""
        own = reduce(_merged, runs, (np.zeros(0, np.int64), np.zeros(0, self._absent.dtype)))
        present = self.is_present(own[1])
        return own if present.all() else _taken(own, present)


def _taken(run: _Run, chosen: Bool[ndarray, " n"]) -> _Run:
    at = np.flatnonzero(chosen)
    return run[0][at], run[1].take(at)


def _merged(run: _Run, other: _Run) -> _Run:
    """Return two runs with different places as one."""
    if not (len(run[0]) and len(other[0])):
        return run if len(run[0]) else other
    at = run[0].searchsorted(other[0]) + np.arange(len(other[0]))
    is_run = np.ones(len(run[0]) + len(other[0]), np.bool_)
    is_run[at] = False
    places, elements = np.empty(len(is_run), np.int64), np.empty(len(is_run), run[1].dtype)
    places[at], _raw(elements)[at] = other[0], _raw(other[1])
    places[is_run], _raw(elements)[is_run] = run[0], _raw(run[1])
    return places, elements


def _raw(elements: Table) -> Table:
    """Return the elements as bytes, which numpy copies at once instead of field by field."""
    return elements.view(f"V{elements.dtype.itemsize}")
