"""Tables of the voxels of a tile: packed elements without keys, so that a voxel costs few bytes of memory.

The elements of a table ascend by their field `offsets`, a voxel's place in its tile. A table never changes: a change
makes another one, so that readers need no copy.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt16
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec.encoded_voxels import join_elements
from gausslite.domain.voxels import BITS_PER_AXIS, TILE_VOXELS, tiles_of

Table = NDArray[Any]
_LOW = TILE_VOXELS - 1
_PLACES = np.arange(TILE_VOXELS**3)
_KEYS = np.bitwise_or.reduce(
    [_PLACES // TILE_VOXELS**axis % TILE_VOXELS << (axis * BITS_PER_AXIS) for axis in range(3)]
)


def by_tile(keys: Int64[ndarray, " n"]) -> Iterator[tuple[int, Int64[ndarray, " p"]]]:
    """Yield each tile with the places of its keys, in their order."""
    tiles = tiles_of(keys)
    if (tiles[1:] == tiles[:-1]).all():
        yield from [(int(tiles[0]), np.arange(len(keys)))] if len(keys) else []
        return
    order = np.argsort(tiles, kind="stable")
    firsts = np.flatnonzero(np.diff(tiles[order], prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*firsts, len(keys)]):
        yield int(tiles[order[start]]), order[start:stop]


def offsets_of(keys: Int64[ndarray, " n"]) -> UInt16[ndarray, " n"]:
    """Return the place of each voxel in its tile; places ascend as the keys of a tile do."""
    i, j, k = (keys >> (axis * BITS_PER_AXIS) & _LOW for axis in (2, 1, 0))
    offsets: UInt16[ndarray, " n"] = ((i * TILE_VOXELS + j) * TILE_VOXELS + k).astype(np.uint16)
    return offsets


def keys_of(tiles: Sequence[int], tables: Sequence[Table]) -> Int64[ndarray, " n"]:
    """Return the keys of the voxels of these tables, one after the other."""
    if not tables:
        return np.zeros(0, np.int64)
    offsets = np.concatenate([table["offsets"] for table in tables])
    keys: Int64[ndarray, " n"] = np.repeat(np.array(tiles, np.int64), list(map(len, tables))) + _KEYS[offsets]
    return keys


def find(table: Table, offsets: UInt16[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the place of each of these voxels in a table, -1 where it has none."""
    own = np.ascontiguousarray(table["offsets"])
    if len(own) == 0:
        return np.full(len(offsets), -1)
    places = np.searchsorted(own, offsets)
    places[places == len(own)] = 0
    places[own[places] != offsets] = -1
    return places


def replaced(table: Table, removed: Int64[ndarray, " n"], added: Table) -> Table:
    """Return the table without the elements at these places (-1: none), with the added ones, whose offsets ascend."""
    if len(table) == 0:
        return added
    kept = np.ones(len(table), np.bool_)
    kept[removed[removed >= 0]] = False
    joined = join_elements([table[kept], added])
    return joined.take(np.argsort(joined["offsets"], kind="stable"))


def joined(tables: Iterable[Table], dtype: np.dtype[Any]) -> Table:
    """Return the elements of all tables."""
    return join_elements([np.zeros(0, dtype), *tables])
