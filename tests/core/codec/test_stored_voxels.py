"""Rows of a store: every bit comes back, and Gaussians of quantised messages take 19 bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.sample_batches import make_batch

from gausslite.codec.stored import CODES, RECORD, from_stored, is_stored, to_records, to_stored
from gausslite.codec.subset_codec import decode_subset, encode_subset
from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid

SIZE_HEADER_BYTES = 8
CASES = st.tuples(
    st.sampled_from([0.1, 0.05, 0.1 / 3, 65535 * 2.0**-20, 1.0]), st.sampled_from([0.0, -3.0, 16.0, 700.0]),
    st.integers(0, 2**32 - 1), st.integers(0, 60),
)  # fmt: skip


def received(batch: VoxelBatch, grid: VoxelGrid) -> VoxelBatch:
    """Return the voxels as a receiver of the quantised message has them."""
    return decode_subset(encode_subset(RoiSubset("ant", "s1", 1, 1, batch), grid))[0].batch


def with_small_labels(batch: VoxelBatch) -> VoxelBatch:
    gaussians = batch.gaussians
    small = replace(gaussians, kappa=gaussians.kappa & np.uint32(0xFFFF), target=gaussians.target % np.int16(127))
    return VoxelBatch(batch.keys, batch.kappa_sums, batch.counts, small)


def require_same(batch: VoxelBatch, rows: list[bytes]) -> None:
    back = from_stored(batch.keys, batch.counts, rows)
    assert to_records(back).tobytes() == to_records(batch.gaussians).tobytes()
    assert all(is_stored(row, count) for row, count in zip(rows, batch.counts.tolist(), strict=True))


@given(CASES)
def test_every_bit_of_any_gaussians_comes_back(case: tuple[float, float, int, int]) -> None:
    size_m, centre_m, seed, n = case
    grid = VoxelGrid(size_m)
    batch = make_batch(seed, n, grid, centre_m=centre_m)
    require_same(batch, to_stored(batch, grid))
    require_same(batch, to_stored(batch, None))
    require_same(received(batch, grid), to_stored(received(batch, grid), grid))


@given(CASES)
def test_received_gaussians_take_19_bytes(case: tuple[float, float, int, int]) -> None:
    size_m, centre_m, seed, n = case
    grid = VoxelGrid(size_m)
    batch = received(with_small_labels(make_batch(seed, n, grid, centre_m=centre_m)), grid)
    rows = to_stored(batch, grid)
    expected = [SIZE_HEADER_BYTES + count * CODES.itemsize if count else 0 for count in batch.counts.tolist()]
    assert [len(row) for row in rows] == expected
    require_same(batch, rows)


@pytest.mark.parametrize("name", ["means_m", "quats_wxyz", "scales_m", "opacities", "rgb"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.0, 3e38, 1e-45])
def test_a_voxel_with_a_value_that_has_no_code_is_stored_exactly_and_the_others_as_codes(
    name: str, value: float
) -> None:
    grid = VoxelGrid(0.1)
    batch = received(with_small_labels(make_batch(3, 60, grid)), grid)
    column = getattr(batch.gaussians, name).copy()
    column[0] = value
    batch = VoxelBatch(batch.keys, batch.kappa_sums, batch.counts, replace(batch.gaussians, **{name: column}))
    rows = to_stored(batch, grid)
    first = int(np.flatnonzero(batch.counts)[0])
    assert len(rows[first]) == int(batch.counts[first]) * RECORD.itemsize
    assert sum(map(len, rows)) < len(batch.gaussians) * RECORD.itemsize / 2
    require_same(batch, rows)


def test_a_wrong_voxel_size_costs_space_and_changes_nothing() -> None:
    batch = received(make_batch(4, 40, VoxelGrid(0.1)), VoxelGrid(0.1))
    require_same(batch, to_stored(batch, VoxelGrid(0.2)))


def test_rows_of_several_voxel_sizes_are_read_together() -> None:
    first, second = (received(make_batch(seed, 30, VoxelGrid(1.0)), VoxelGrid(1.0)) for seed in (1, 2))
    rows = [*to_stored(first, VoxelGrid(1.0)), *to_stored(second, None)]
    keys, counts = np.concatenate([first.keys, second.keys]), np.concatenate([first.counts, second.counts])
    order = np.random.default_rng(0).permutation(len(keys))
    back = from_stored(keys[order], counts[order], [rows[i] for i in order])
    both = Gaussians.concatenate([first.gaussians, second.gaussians])
    ends = np.cumsum(counts, dtype=np.int64)
    shuffled = np.concatenate([np.arange(ends[i] - counts[i], ends[i]) for i in order])
    assert to_records(back).tobytes() == to_records(both.take(shuffled)).tobytes()


def test_a_damaged_row_is_named() -> None:
    grid = VoxelGrid(0.1)
    batch = received(with_small_labels(make_batch(5, 20, grid)), grid)
    rows = to_stored(batch, grid)
    first = int(np.flatnonzero(batch.counts)[0])
    for damaged in (rows[first][:-1], rows[first] + b"0", b"", bytes(8) + rows[first][8:], rows[first][:8] + b"\xff" * (
        len(rows[first]) - 8
    )):  # fmt: skip
        with pytest.raises(StorageError, match="the store is damaged"):
            from_stored(batch.keys, batch.counts, [*rows[:first], damaged, *rows[first + 1 :]])
