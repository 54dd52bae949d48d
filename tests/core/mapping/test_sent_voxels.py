"""Batches of voxels, and the tracker of sent voxels."""

import numpy as np
import pytest
from sample_gaussians import some_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, empty_batch, group_by_voxel
from gausslite.mapping.voxel_exchange import SentVoxelTracker

GRID = VoxelGrid(0.5)


def active_gaussians(count: int = 60) -> Gaussians:
    gaussians = some_gaussians(count)
    gaussians.active[:] = True
    return gaussians


def test_a_batch_has_each_gaussian_once_in_its_voxel_with_totals() -> None:
    gaussians = some_gaussians(200)
    batch = group_by_voxel(gaussians, GRID)
    assert int(batch.counts.sum()) == 200
    np.testing.assert_array_equal(np.repeat(batch.keys, batch.counts), GRID.keys(batch.gaussians.means_m))
    assert int(batch.kappa_sums.sum()) == int(gaussians.kappa.sum())
    first = batch.gaussians.kappa[: batch.counts[0]]
    assert int(batch.kappa_sums[0]) == int(first.sum())


def test_no_gaussians_give_an_empty_batch() -> None:
    assert len(group_by_voxel(Gaussians.empty(), GRID)) == 0
    assert len(SentVoxelTracker(GRID).collect_changes(Gaussians.empty())) == 0


def test_the_first_call_returns_all_active_voxels_and_the_second_none() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), some_gaussians(100)
    batch = tracker.collect_changes(gaussians)
    assert len(batch.gaussians) == int(gaussians.active.sum())
    assert batch.gaussians.active.all()
    assert len(tracker.collect_changes(gaussians)) == 0


def test_the_order_of_gaussians_is_not_a_change() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    tracker.collect_changes(gaussians)
    assert len(tracker.collect_changes(gaussians.take(np.random.default_rng(0).permutation(60)))) == 0


def test_a_change_of_any_value_returns_only_that_voxel() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    tracker.collect_changes(gaussians)
    key = GRID.keys(gaussians.means_m[3:4])[0]
    for column in ("kappa", "opacities", "rgb", "scales_m", "quats_wxyz", "target"):
        values = getattr(gaussians, column)
        values[3] = values[3] + values.dtype.type(1)
        batch = tracker.collect_changes(gaussians)
        assert batch.keys.tolist() == [key], column
        assert int(batch.counts[0]) == int((GRID.keys(gaussians.means_m) == key).sum())


def test_values_swapped_between_two_gaussians_of_a_voxel_are_a_change() -> None:
    gaussians = active_gaussians(2)
    gaussians.means_m[:] = [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2]]
    tracker = SentVoxelTracker(GRID)
    tracker.collect_changes(gaussians)
    gaussians.rgb[:] = gaussians.rgb[::-1].copy()
    assert len(tracker.collect_changes(gaussians)) == 1


def test_a_voxel_that_lost_its_gaussians_gets_one_tombstone() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    tracker.collect_changes(gaussians)
    keys = GRID.keys(gaussians.means_m)
    left = gaussians.take(keys != keys[5])
    batch = tracker.collect_changes(left)
    assert batch.keys.tolist() == [keys[5]]
    assert batch.counts.tolist() == [0]
    assert batch.kappa_sums.tolist() == [0]
    assert len(tracker.collect_changes(left)) == 0


def test_encoded_voxels_get_tombstones_unless_they_are_in_the_batch_or_frozen() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    whole = tracker.collect_changes(gaussians)
    tracker.freeze_sent()
    lost = whole.keys[0] - 1
    result = tracker.add_tombstones(whole, np.array([lost, *whole.keys]))
    assert result.keys.tolist() == [lost, *whole.keys]
    assert result.counts.tolist() == [0, *whole.counts]
    # frozen voxels keep what was sent, also if the batch does not have them
    assert tracker.add_tombstones(empty_batch(), np.array([lost, *whole.keys])).keys.tolist() == [lost]
    assert SentVoxelTracker(GRID).add_tombstones(empty_batch(), whole.keys).keys.tolist() == whole.keys.tolist()


def test_frozen_voxels_get_no_updates_and_no_tombstones() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    tracker.collect_changes(gaussians)
    tracker.freeze_sent()
    gaussians.active[:] = False
    gaussians.rgb[:] = 0.0
    assert len(tracker.collect_changes(gaussians)) == 0
    assert len(tracker.collect_changes(gaussians.take(np.arange(0)))) == 0


def test_a_frozen_voxel_is_replaced_only_at_an_equal_or_higher_kappa_sum() -> None:
    tracker, gaussians = SentVoxelTracker(GRID), active_gaussians()
    gaussians.kappa[:] = 10
    sent = {int(key): int(total) for key, total in zip(*_sums(tracker.collect_changes(gaussians)), strict=True)}
    tracker.freeze_sent()
    less = gaussians.take(np.arange(len(gaussians)))
    less.kappa[:] = 9
    assert len(tracker.collect_changes(less)) == 0
    assert len(tracker.exclude_frozen(group_by_voxel(less, GRID))) == 0
    less.kappa[:] = 11
    again = {int(key): int(total) for key, total in zip(*_sums(tracker.collect_changes(less)), strict=True)}
    assert set(again) == set(sent)
    assert all(again[key] >= sent[key] for key in sent)
    # from now on these voxels are not frozen: removed ones get tombstones
    assert tracker.collect_changes(less.take(np.arange(0))).keys.tolist() == sorted(sent)


def _sums(batch: VoxelBatch) -> tuple[list[int], list[int]]:
    return batch.keys.tolist(), batch.kappa_sums.tolist()


def test_applying_all_changes_in_order_rebuilds_the_map() -> None:
    rng, tracker = np.random.default_rng(0), SentVoxelTracker(GRID)
    latest: dict[int, tuple[int, int]] = {}
    gaussians = active_gaussians(80)
    for _ in range(5):
        gaussians = gaussians.take(rng.random(len(gaussians)) < 0.8)
        gaussians.kappa[rng.random(len(gaussians)) < 0.3] += 1
        batch = tracker.collect_changes(gaussians)
        for key, kappa, count in zip(batch.keys, batch.kappa_sums, batch.counts, strict=True):
            latest[int(key)] = (int(kappa), int(count))
    whole = group_by_voxel(gaussians, GRID)
    remaining = {key: sums for key, sums in latest.items() if sums[1] > 0}
    assert remaining == {
        int(key): (int(kappa), int(count))
        for key, kappa, count in zip(whole.keys, whole.kappa_sums, whole.counts, strict=True)
    }


@pytest.mark.parametrize("reach_m", [0.0, 0.9, 50.0])
@pytest.mark.parametrize("count", [0, 400])
def test_points_are_grouped_in_the_order_of_their_keys(reach_m: float, count: int) -> None:
    points_m = np.random.default_rng(0).uniform(-reach_m, reach_m, (count, 3)).astype(np.float32) + np.float32(7.0)
    rows, starts = VoxelGrid().sort_by_voxel(points_m)
    keys = VoxelGrid().keys(points_m)
    np.testing.assert_array_equal(rows, np.argsort(keys, kind="stable"))
    np.testing.assert_array_equal(keys[rows[starts]], np.unique(keys))
