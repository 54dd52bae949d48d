"""Splat table: optimiser state after each operation, and the cap."""

import numpy as np
import pytest
from sample_gaussians import some_gaussians

from gausslite.domain.errors import QuotaError
from gausslite.mapping.splat_table import SplatTable


def test_memory_is_aligned_and_allocated_once() -> None:
    table = SplatTable(100)
    address = table.rows.__array_interface__["data"][0]
    assert address % 64 == 0
    table.append(some_gaussians(60))
    table.keep(np.arange(60) % 2 == 0)
    table.append(some_gaussians(70))
    assert table.rows.__array_interface__["data"][0] == address
    assert (table.count, table.free_slots) == (100, 0)


def test_append_beyond_the_cap_is_rejected_without_change() -> None:
    table = SplatTable(10)
    table.append(some_gaussians(8))
    pytest.raises(QuotaError, table.append, some_gaussians(3)).match("at most 2")
    assert table.count == 8


def test_keep_moves_only_the_last_rows_and_their_optimiser_state() -> None:
    table = SplatTable(20)
    table.append(some_gaussians(20))
    table.first_moment[:] = np.arange(20)[:, None]
    table.second_moment[:] = 100 + np.arange(20)[:, None]
    rows, kappa = table.rows.copy(), table.kappa.copy()
    mask = np.random.default_rng(1).random(20) < 0.6
    table.keep(mask)
    expected_order = np.arange(mask.sum())
    expected_order[~mask[: len(expected_order)]] = len(expected_order) + np.flatnonzero(mask[len(expected_order) :])
    assert set(expected_order) == set(np.flatnonzero(mask))
    np.testing.assert_array_equal(table.rows, rows[expected_order])
    np.testing.assert_array_equal(table.kappa, kappa[expected_order])
    np.testing.assert_array_equal(table.first_moment[:, 0], expected_order)
    np.testing.assert_array_equal(table.second_moment[:, 0], 100 + expected_order)


def test_append_resets_optimiser_state_of_reused_rows_only() -> None:
    table = SplatTable(20)
    table.append(some_gaussians(20))
    table.first_moment[:] = 7.0
    table.second_moment[:] = 8.0
    table.keep(np.arange(20) < 10)
    table.append(some_gaussians(5))
    assert (table.first_moment[:10] == 7.0).all()
    assert (table.second_moment[:10] == 8.0).all()
    assert not table.first_moment[10:].any()
    assert not table.second_moment[10:].any()


def test_to_gaussians_copies() -> None:
    table = SplatTable(5)
    table.append(some_gaussians(5))
    copied = table.to_gaussians(np.array([4, 1]))
    table.rows[:] = 0.0
    table.kappa[:] = 0
    expected = some_gaussians(5).take(np.array([4, 1]))
    np.testing.assert_allclose(copied.means_m, expected.means_m)
    np.testing.assert_array_equal(copied.kappa, expected.kappa)
