"""Where the Gaussians of an agent whose frame is corrected lie in the fused grid: by sent voxel, and by fused voxel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.voxels import gather_rows

PAIRS = np.dtype([("sources", "i8"), ("cells", "i8"), ("kappas", "u8"), ("counts", "u4")])
Pairs = NDArray[Any]
"""What voxels as sent (sources) have in fused voxels (cells): Σkappa and number of Gaussians, at least 1."""
_NO_CELL = -1
"""The cell of a source that is used nowhere."""
_RATIO = 4
"""How much larger a run is than the next one, at least, so that a pair is sorted anew only a few times."""


class MovedVoxels:
    """The pairs of an agent, found by source and by cell. Sources that are not in it are used as sent."""

    def __init__(self) -> None:
        self._by_source, self._by_cell = _Runs("sources"), _Runs("cells")

    @property
    def is_empty(self) -> bool:
        """True if every voxel is used as sent."""
        return self._by_source.is_empty

    @property
    def memory_bytes(self) -> int:
        """What it takes."""
        return self._by_source.memory_bytes + self._by_cell.memory_bytes

    def has(self, keys: Int64[ndarray, " k"]) -> Bool[ndarray, " k"]:
        """Return which of these voxels are not used as sent."""
        return np.isin(keys, self._by_source.rows(np.unique(keys))["sources"])

    def pairs(self, cells: Int64[ndarray, " k"] | None) -> Pairs:
        """Return the pairs in these voxels of the fused grid, or all."""
        return self._by_cell.rows(None if cells is None else np.unique(cells))

    def remove(self, sources: Int64[ndarray, " a"]) -> Int64[ndarray, " k"]:
        """Use these voxels as sent; returns the fused voxels where they lay."""
        before = self._by_source.remove(sources, sources)
        cells = np.unique(before["cells"][before["cells"] != _NO_CELL])
        self._by_cell.remove(cells, sources)
        return cells

    def replace(self, sources: Int64[ndarray, " a"], pairs: Pairs) -> Int64[ndarray, " k"]:
        """Replace the pairs of these voxels, all different; returns the fused voxels that may change."""
        as_sent = sources[~self.has(sources)]  # until now these lay where they were sent
        before = self.remove(sources)
        # a source without pairs is remembered too, else it would count as used where it was sent
        unused = np.setdiff1d(sources, pairs["sources"])
        nowhere = np.zeros(len(unused), PAIRS)
        nowhere["sources"], nowhere["cells"], nowhere["counts"] = unused, _NO_CELL, 1
        self._by_source.add(np.concatenate([pairs, nowhere]))
        self._by_cell.add(pairs)
        changed: Int64[ndarray, " k"] = np.unique(np.concatenate([as_sent, before, pairs["cells"]]))
        return changed


class _Runs:
    """Pairs sorted by one of their voxels, in runs as of PackedTable. Deleted ones have count 0 until a merge."""

    def __init__(self, field: str) -> None:
        self._field = field
        self._runs: list[tuple[Int64[ndarray, " n"], Pairs]] = []

    @property
    def is_empty(self) -> bool:
        return not any(len(at) for _, at in self._find(None))

    @property
    def memory_bytes(self) -> int:
        return sum(keys.nbytes + pairs.nbytes for keys, pairs in self._runs)

    def rows(self, keys: Int64[ndarray, " k"] | None) -> Pairs:
        """Return the pairs of these voxels, all different, or all."""
        found = [pairs[at] for pairs, at in self._find(keys)]
        return np.concatenate([np.zeros(0, PAIRS), *found])

    def remove(self, keys: Int64[ndarray, " k"], sources: Int64[ndarray, " a"]) -> Pairs:
        """Delete those pairs of these voxels that have one of these sources; returns them."""
        removed = [np.zeros(0, PAIRS)]
        for pairs, at in self._find(keys):
            own = at[np.isin(pairs["sources"][at], sources)]
            removed.append(pairs[own])
            pairs["counts"][own] = 0
        return np.concatenate(removed)

    def add(self, pairs: Pairs) -> None:
        """Add pairs."""
        if len(pairs):
            self._runs.append(self._sorted(pairs))
        while len(self._runs) > 1 and len(self._runs[-2][0]) < _RATIO * len(self._runs[-1][0]):
            self._runs[-2:] = [self._sorted(np.concatenate([pairs for _, pairs in self._runs[-2:]]))]

    def _sorted(self, pairs: Pairs) -> tuple[Int64[ndarray, " n"], Pairs]:
        at = np.flatnonzero(pairs["counts"])
        at = at[np.argsort(pairs[self._field][at], kind="stable")]
        return np.ascontiguousarray(pairs[self._field][at]), pairs[at]

    def _find(self, keys: Int64[ndarray, " k"] | None) -> Iterator[tuple[Pairs, Int64[ndarray, " n"]]]:
        """Yield each run with the indices of those of its pairs that have these voxels."""
        for own, pairs in self._runs:
            if keys is None:
                at = np.arange(len(own))
            else:
                starts = own.searchsorted(keys)
                at = gather_rows(starts, own.searchsorted(keys, side="right") - starts)
            yield pairs, at[pairs["counts"][at] > 0]
