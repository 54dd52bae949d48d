"""The voxels of an agent in another frame: what a table of dictionaries says, in a bounded number of bytes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gausslite.fusion.moved_voxels import PAIRS, MovedVoxels

SOURCES = st.integers(0, 12)
CHANGES = st.lists(
    st.dictionaries(SOURCES, st.none() | st.dictionaries(st.integers(0, 6), st.integers(1, 9), max_size=3), max_size=5),
    max_size=12,
)


def _pairs(cells_of):
    rows = [(source, cell, count * 2, count) for source, cells in cells_of.items() for cell, count in cells.items()]
    return np.array(rows, PAIRS)


@given(CHANGES)
def test_pairs_are_those_of_the_last_replacement_of_each_source(changes):
    moved, expected = MovedVoxels(), {}
    for change in changes:
        placed = {source: cells for source, cells in change.items() if cells is not None}
        as_sent = np.array(sorted(change.keys() - placed.keys()), np.int64)
        before = {cell for source in change for cell in expected.get(source, ())}
        new = placed.keys() - expected.keys() | {cell for cells in placed.values() for cell in cells}
        changed = [*moved.remove(as_sent), *moved.replace(np.array(sorted(placed), np.int64), _pairs(placed))]
        assert set(changed) == before | new
        expected = {source: cells for source, cells in (expected | placed).items() if source not in as_sent}
        for cells in (None, np.array([0, 3, 3], np.int64)):
            wanted = _pairs(
                {s: {c: n for c, n in own.items() if cells is None or c in cells} for s, own in expected.items()}
            )
            np.testing.assert_array_equal(np.sort(moved.pairs(cells)), np.sort(wanted))
        np.testing.assert_array_equal(moved.has(np.arange(13)), np.isin(np.arange(13), list(expected)))
        assert moved.is_empty == (not expected)


def test_memory_stays_bounded_when_the_same_voxels_are_replaced_again_and_again():
    moved, sources = MovedVoxels(), np.arange(1000)
    pairs = np.zeros(1000, PAIRS)
    pairs["sources"], pairs["cells"], pairs["counts"] = sources, sources, 1
    for part in np.split(np.tile(np.arange(1000), 40), 400):
        moved.replace(part, pairs[part])
    assert len(moved.pairs(None)) == 1000
    assert moved.memory_bytes < 1000 * 200
