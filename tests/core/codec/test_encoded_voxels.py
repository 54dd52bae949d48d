"""Rows of a store: every bit comes back, and Gaussians of quantised messages take 21 bytes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.sample_batches import make_batch

from gausslite.codec.body import SubsetCoding
from gausslite.codec.encoded_voxels import CODES, RECORD, VOXELS, EncodedVoxels, to_records
from gausslite.codec.subset_codec import decode_subset, encode_subset, unpack_subset
from gausslite.domain.errors import CodecError, StorageError
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, tiles_of

HEAD_BYTES = 12
CASES = st.tuples(
    st.sampled_from([0.1, 0.05, 0.1 / 3, 65535 * 2.0**-20, 1.0]), st.sampled_from([0.0, -3.0, 16.0, 700.0]),
    st.integers(0, 2**32 - 1), st.integers(0, 60),
)  # fmt: skip


def require_same(voxels: EncodedVoxels, expected: VoxelBatch) -> None:
    batch = voxels.batch()
    assert to_records(batch.gaussians).tobytes() == to_records(expected.gaussians).tobytes()
    for name in ("keys", "kappa_sums", "counts"):
        assert getattr(batch, name).tolist() == getattr(expected, name).tolist()


def with_computed_sums(batch: VoxelBatch) -> VoxelBatch:
    totals = np.concatenate([np.zeros(1, np.uint64), np.cumsum(batch.gaussians.kappa, dtype=np.uint64)])
    return replace(batch, kappa_sums=totals[batch.offsets[1:]] - totals[batch.offsets[:-1]])


def with_few_targets(batch: VoxelBatch) -> VoxelBatch:
    return replace(batch, gaussians=replace(batch.gaussians, target=batch.gaussians.target % np.int16(127)))


@given(CASES, st.sampled_from(SubsetCoding))
def test_every_bit_of_a_message_comes_back_from_its_rows(case: tuple[float, float, int, int], coding) -> None:
    size_m, centre_m, seed, n = case
    grid = VoxelGrid(size_m)
    message = encode_subset(RoiSubset("ant", "s", 7, 9, make_batch(seed, n, grid, centre_m=centre_m)), grid, coding)
    expected, stored = with_computed_sums(decode_subset(message)[0].batch), unpack_subset(message)[0]
    assert (stored.agent_id, stored.message_seq, stored.update_seq) == ("ant", 7, 9)
    require_same(stored.voxels, expected)
    parts = [EncodedVoxels.from_row(part.to_row()) for part in stored.voxels.by_tile()]
    assert all(len(set(tiles_of(part.keys).tolist())) == 1 for part in parts)
    if parts:
        together = EncodedVoxels.concatenate(parts)
        assert set(together.voxels["update_seqs"].tolist()) == {9}
        require_same(together.take(np.argsort(together.keys)), expected)


@given(CASES, st.integers(1, 9))
def test_slices_are_the_voxels_in_order(case: tuple[float, float, int, int], step: int) -> None:
    size_m, centre_m, seed, n = case
    whole = EncodedVoxels.exact(make_batch(seed, n, VoxelGrid(size_m), centre_m=centre_m), 3)
    slices = [whole.slice(start, start + step) for start in range(0, len(whole), step)]
    if slices:
        require_same(EncodedVoxels.concatenate(slices), whole.batch())


@given(CASES)
def test_received_gaussians_take_21_bytes(case: tuple[float, float, int, int]) -> None:
    size_m, centre_m, seed, n = case
    grid = VoxelGrid(size_m)
    batch = with_few_targets(make_batch(seed, n, grid, centre_m=centre_m))
    voxels = unpack_subset(encode_subset(RoiSubset("ant", "s", 1, 1, batch), grid))[0].voxels
    assert len(voxels.to_row()) == HEAD_BYTES + VOXELS.itemsize * len(batch) + 21 * n


@pytest.mark.parametrize("coding", SubsetCoding)
def test_sums_are_computed_whatever_a_message_states(coding: SubsetCoding) -> None:
    grid = VoxelGrid(0.1)
    batch = make_batch(3, 60, grid)
    voxels = unpack_subset(encode_subset(RoiSubset("ant", "s", 1, 1, batch), grid, coding))[0].voxels
    assert voxels.voxels["kappa_sums"].tolist() == with_computed_sums(batch).kappa_sums.tolist()
    assert EncodedVoxels.exact(batch, 1).with_computed_sums().voxels.tolist() == voxels.voxels.tolist()
    assert voxels.voxels["kappa_sums"].tolist() != batch.kappa_sums.tolist()


def test_voxels_that_do_not_ascend_are_refused() -> None:
    grid = VoxelGrid(0.1)
    batch = make_batch(3, 60, grid)
    message = encode_subset(RoiSubset("ant", "s", 1, 1, batch), grid)
    keys = batch.keys.copy()
    keys[1] = keys[0]
    object.__setattr__(batch, "keys", keys)
    moved = replace(batch.gaussians, means_m=np.repeat(grid.centres_m(keys), batch.counts, axis=0))
    object.__setattr__(batch, "gaussians", moved)
    unpack_subset(message)
    pytest.raises(CodecError, unpack_subset, encode_subset(RoiSubset("ant", "s", 1, 1, batch), grid)).match("ascending")


def test_a_damaged_row_is_named() -> None:
    grid = VoxelGrid(0.1)
    batch = with_few_targets(make_batch(5, 20, grid))
    row = unpack_subset(encode_subset(RoiSubset("ant", "s", 1, 1, batch), grid))[0].voxels.to_row()
    whole = EncodedVoxels.exact(batch, 1).to_row()
    assert (len(row) - len(whole)) == len(batch.gaussians) * (CODES.itemsize - RECORD.itemsize)
    for damaged in (row[:-1], row + b"0", row[:5], b"", row[:8] + b"\xff\xff\xff\xff" + row[12:], bytes(8) + row[8:]):
        pytest.raises(StorageError, EncodedVoxels.from_row, damaged).match("damaged")
