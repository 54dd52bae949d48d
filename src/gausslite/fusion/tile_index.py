"""Group the voxels of a map by spatial tile, so that watchers get it tile by tile and share the encoded tiles."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.voxels import tile_of


class TileIndex:
    """The voxels of each tile of 16 x 16 x 16 voxels, and the revision of its last change. Not thread-safe."""

    def __init__(self) -> None:
        self._keys: dict[int, set[int]] = {}
        self._revisions: dict[int, int] = {}

    def __contains__(self, key: int) -> bool:
        return key in self._keys.get(tile_of(key), ())

    def tiles(self) -> Int64[ndarray, " t"]:
        """Return the tiles that have voxels, ascending; a tile is named by the smallest key that it can hold."""
        return np.sort(np.fromiter(self._keys, np.int64, len(self._keys)))

    def keys(self, tile: int) -> Int64[ndarray, " k"]:
        """Return the voxels of a tile, ascending."""
        return np.array(sorted(self._keys.get(tile, ())), np.int64)

    def all_keys(self) -> set[int]:
        """Return the voxels of all tiles."""
        return set().union(*self._keys.values())

    def revision(self, tile: int) -> int:
        """Return the revision of the last change in a tile; 0 if it never had voxels."""
        return self._revisions.get(tile, 0)

    def record(self, changed: Iterable[int], removed: Iterable[int], revision: int) -> None:
        """Record that these voxels changed or became empty at this revision."""
        for key in changed:
            tile = tile_of(key)
            self._keys.setdefault(tile, set()).add(key)
            self._revisions[tile] = revision
        for key in removed:
            tile = tile_of(key)
            own = self._keys.get(tile, set())
            own.discard(key)
            if not own:
                self._keys.pop(tile, None)
            self._revisions[tile] = revision
