"""Who gives way when seeds come to a full table, and that the cap holds at every instant."""

from __future__ import annotations

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.eviction import insert_seeds
from gausslite.mapping.seeding import Seeds
from gausslite.optimize.splat_table import SplatTable

NEWBORN = 0.5


def gaussians(opacities: list[float], active: bool, target: int = -1) -> Gaussians:
    return plain_gaussians(np.zeros((len(opacities), 3)), opacities=opacities, active=active, target=target)


def full_table() -> SplatTable:
    table = SplatTable(6)
    table.append(gaussians([0.9, 0.2, 0.7], active=False))
    table.append(gaussians([0.1, 0.8, 0.3], active=True))
    return table


def insert_into(table: SplatTable, roi: int, rest: int, scaffold: int = 0) -> int:
    seeds = Seeds(gaussians([NEWBORN] * roi, True, 7), gaussians([NEWBORN] * rest, False, 8))
    return insert_seeds(table, seeds, NEWBORN, np.random.default_rng(0), scaffold)


def test_with_room_nobody_gives_way() -> None:
    table = SplatTable(10)
    table.append(gaussians([0.1, 0.2], active=False))
    assert insert_into(table, 3, 4) == 7
    assert table.count == 9


def test_for_the_task_the_faintest_inactive_gives_way_first_then_the_faintest_active() -> None:
    table = full_table()
    assert insert_into(table, 2, 0) == 2
    np.testing.assert_allclose(np.sort(table.opacities), [0.1, 0.3, 0.5, 0.5, 0.8, 0.9], rtol=1e-4)
    table = full_table()
    insert_into(table, 4, 0)
    np.testing.assert_allclose(np.sort(table.opacities), [0.3, 0.5, 0.5, 0.5, 0.5, 0.8], rtol=1e-4)


def test_for_the_rest_only_inactive_ones_fainter_than_a_newborn_give_way() -> None:
    table = full_table()
    assert insert_into(table, 0, 5) == 1
    np.testing.assert_allclose(np.sort(table.opacities), [0.1, 0.3, 0.5, 0.7, 0.8, 0.9], rtol=1e-4)


def test_seeds_take_the_rows_of_those_that_gave_way_with_fresh_state_and_no_other_row_moves() -> None:
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


def test_of_equally_faint_ones_the_earlier_gives_way() -> None:
    table = SplatTable(4)
    table.append(gaussians([0.2, 0.2, 0.1, 0.2], active=False))
    insert_into(table, 2, 0)
    assert table.target.tolist() == [7, -1, 7, -1]


def test_the_tasks_seeds_are_served_before_the_rest() -> None:
    table = SplatTable(5)
    assert insert_into(table, 4, 4) == 5
    assert (table.target == 7).sum() == 4


def test_more_seeds_of_the_task_than_the_whole_cap() -> None:
    table = full_table()
    assert insert_into(table, 50, 50) == 6
    assert (table.target == 7).all()


def test_the_scaffold_stays_and_of_the_region_the_faintest_give_way_instead() -> None:
    table = full_table()
    assert insert_into(table, 3, 0, scaffold=2) == 3
    np.testing.assert_allclose(np.sort(table.opacities[~table.active]), [0.7, 0.9], rtol=1e-4)
    np.testing.assert_allclose(np.sort(table.opacities[table.active]), [0.5, 0.5, 0.5, 0.8], rtol=1e-4)


def test_without_as_many_inactive_ones_as_the_scaffold_none_of_them_gives_way() -> None:
    table = full_table()
    assert insert_into(table, 50, 0, scaffold=5) == 3
    assert table.count == 6
    np.testing.assert_allclose(np.sort(table.opacities[~table.active]), [0.2, 0.7, 0.9], rtol=1e-4)
