"""Eviction order when seeds are inserted into a full table, and the cap."""

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.seeding import Seeds, insert_seeds
from gausslite.mapping.splat_table import SplatTable

SEED_OPACITY = 0.5


def gaussians(opacities: list[float], active: bool, target: int = -1) -> Gaussians:
    return plain_gaussians(np.zeros((len(opacities), 3)), opacities=opacities, active=active, target=target)


def full_table() -> SplatTable:
    table = SplatTable(6)
    table.append(gaussians([0.9, 0.2, 0.7], active=False))
    table.append(gaussians([0.1, 0.8, 0.3], active=True))
    return table


def insert_into(table: SplatTable, roi: int, background: int, min_background: int = 0) -> int:
    seeds = Seeds(gaussians([SEED_OPACITY] * roi, True, 7), gaussians([SEED_OPACITY] * background, False, 8))
    return insert_seeds(table, seeds, SEED_OPACITY, np.random.default_rng(0), min_background)


def test_with_free_slots_nothing_is_evicted() -> None:
    table = SplatTable(10)
    table.append(gaussians([0.1, 0.2], active=False))
    assert insert_into(table, 3, 4) == 7
    assert table.count == 9


def test_roi_seeds_evict_the_least_opaque_inactive_first_then_the_least_opaque_active() -> None:
    table = full_table()
    assert insert_into(table, 2, 0) == 2
    np.testing.assert_allclose(np.sort(table.opacities), [0.1, 0.3, 0.5, 0.5, 0.8, 0.9], rtol=1e-4)
    table = full_table()
    insert_into(table, 4, 0)
    np.testing.assert_allclose(np.sort(table.opacities), [0.3, 0.5, 0.5, 0.5, 0.5, 0.8], rtol=1e-4)


def test_background_seeds_evict_only_inactive_gaussians_less_opaque_than_a_seed() -> None:
    table = full_table()
    assert insert_into(table, 0, 5) == 1
    np.testing.assert_allclose(np.sort(table.opacities), [0.1, 0.3, 0.5, 0.7, 0.8, 0.9], rtol=1e-4)


def test_seeds_reuse_evicted_rows_with_new_optimiser_state_and_other_rows_stay() -> None:
    table = full_table()
    before = table.rows.copy()
    table.first_moment[:], table.second_moment[:] = 1.0, 2.0
    insert_into(table, 3, 0)
    taken = table.target == 7
    assert taken.sum() == 3
    np.testing.assert_array_equal(table.rows[~taken], before[~taken])
    for moment, value in ((table.first_moment, 1.0), (table.second_moment, 2.0)):
        assert not moment[taken].any()
        assert (moment[~taken] == value).all()


def test_ties_evict_the_earlier_row() -> None:
    table = SplatTable(4)
    table.append(gaussians([0.2, 0.2, 0.1, 0.2], active=False))
    insert_into(table, 2, 0)
    assert table.target.tolist() == [7, -1, 7, -1]


def test_roi_seeds_are_inserted_before_background_seeds() -> None:
    table = SplatTable(5)
    assert insert_into(table, 4, 4) == 5
    assert (table.target == 7).sum() == 4


def test_more_roi_seeds_than_the_cap() -> None:
    table = full_table()
    assert insert_into(table, 50, 50) == 6
    assert (table.target == 7).all()


def test_a_minimum_of_background_stays_and_active_gaussians_are_evicted_instead() -> None:
    table = full_table()
    assert insert_into(table, 3, 0, min_background=2) == 3
    np.testing.assert_allclose(np.sort(table.opacities[~table.active]), [0.7, 0.9], rtol=1e-4)
    np.testing.assert_allclose(np.sort(table.opacities[table.active]), [0.5, 0.5, 0.5, 0.8], rtol=1e-4)


def test_background_below_its_minimum_is_not_evicted() -> None:
    table = full_table()
    assert insert_into(table, 50, 0, min_background=5) == 3
    assert table.count == 6
    np.testing.assert_allclose(np.sort(table.opacities[~table.active]), [0.2, 0.7, 0.9], rtol=1e-4)
