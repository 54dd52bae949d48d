"""Clone, split and prune: selection, inheritance and the cap."""

import numpy as np
import pytest

from gausslite.mapping.density import densify, prune
from gausslite.mapping.settings import DensitySettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, UPDATE_COUNT

SETTINGS = DensitySettings(max_growth=1.0)
EXTENT_M = 1.0


def table_of(scales_m: list[float], gradients: list[float], capacity: int) -> SplatTable:
    table, count = SplatTable(capacity), len(scales_m)
    rows = np.zeros((count, 16), np.float32)
    rows[:, MEAN] = np.arange(count)[:, None]
    rows[:, LOG_SCALE] = np.log(np.array(scales_m, np.float32))[:, None]
    rows[:, QUAT] = (1.0, 0.0, 0.0, 0.0)
    rows[:, UPDATE_COUNT] = 9.0
    target = np.arange(count).astype(np.int16)
    table.append_rows(rows, target % 2 == 1, (10 * target).astype(np.uint32), target)
    table.first_moment[:] = 3.0
    table.second_moment[:] = 4.0
    table.roi_evidence[:] = 20 - target
    table.first_moment[:, GRAD_2D_COUNT] = 5.0
    table.first_moment[:, GRAD_2D_SUM] = 5.0 * np.array(gradients, np.float32)
    return table


def test_small_are_cloned_large_are_split_low_gradients_are_unchanged() -> None:
    table = table_of([0.001, 0.1, 0.1], [1e-3, 1e-3, 1e-5], capacity=10)
    before = table.rows.copy()
    densify(table, SETTINGS, EXTENT_M)
    assert table.count == 5
    np.testing.assert_array_equal(table.rows[2], before[2])
    parent, clone = table.rows[table.target == 0]
    np.testing.assert_array_equal(clone[:UPDATE_COUNT], parent[:UPDATE_COUNT])
    changed = [OPACITY_LOGIT, UPDATE_COUNT]
    np.testing.assert_array_equal(np.delete(clone, changed), np.delete(before[0], changed))
    halves = table.rows[table.target == 1]
    np.testing.assert_allclose(halves[:, LOG_SCALE], np.log([[0.1 / 1.6, 0.1, 0.1]] * 2), rtol=1e-5)
    assert not np.array_equal(halves[0], halves[1])


@pytest.mark.parametrize("logit", [-5.0, 0.0, 3.0, 12.0])
def test_clone_and_parent_have_the_transmittance_of_the_parent(logit: float) -> None:
    table = table_of([0.001], [1e-3], capacity=2)
    table.rows[:, OPACITY_LOGIT] = logit
    opacity = table.opacities[0]
    densify(table, SETTINGS, EXTENT_M)
    np.testing.assert_allclose(1.0 - np.prod(1.0 - table.opacities.astype(np.float64)), opacity, rtol=1e-4)


def test_split_keeps_mean_and_covariance() -> None:
    table = table_of([0.1], [1e-3], capacity=2)
    table.rows[:, LOG_SCALE] = np.log([0.02, 0.1, 0.05])
    before = table.rows[0, MEAN].copy()
    densify(table, SETTINGS, EXTENT_M)
    means, scales_m = table.rows[:, MEAN], np.exp(table.rows[:, LOG_SCALE])
    np.testing.assert_allclose(means.mean(axis=0), before, atol=1e-6)
    variance_m2 = (scales_m**2).mean(axis=0) + means.var(axis=0)
    np.testing.assert_allclose(np.sqrt(variance_m2), [0.02, 0.1, 0.05], rtol=1e-4)


def test_children_inherit_columns_and_new_rows_have_no_optimiser_state() -> None:
    table = table_of([0.001, 0.1, 0.1], [1e-3, 1e-3, 1e-5], capacity=10)
    densify(table, SETTINGS, EXTENT_M)
    np.testing.assert_array_equal(table.kappa, 10 * table.target)
    np.testing.assert_array_equal(table.active, table.target % 2 == 1)
    np.testing.assert_array_equal(table.roi_evidence, 20 - table.target)
    unchanged, new = [0, 2], [1, 3, 4]
    assert (table.first_moment[unchanged, :OPACITY_LOGIT] == 3.0).all()
    assert (table.second_moment[unchanged] == 4.0).all()
    assert (table.rows[unchanged, UPDATE_COUNT] == 9.0).all()
    assert not table.first_moment[new].any()
    assert not table.second_moment[new].any()
    assert not table.rows[new, UPDATE_COUNT].any()


def test_densify_resets_the_statistics() -> None:
    table = table_of([0.001] * 3, [1e-3] * 3, capacity=10)
    densify(table, SETTINGS, EXTENT_M)
    assert not table.first_moment[:, [GRAD_2D_SUM, GRAD_2D_COUNT]].any()


def test_largest_gradients_have_priority() -> None:
    table = table_of([0.001] * 5, [3e-3, 5e-3, 1e-3, 4e-3, 2e-3], capacity=7)
    densify(table, SETTINGS, EXTENT_M)
    assert table.count == 7
    assert sorted(table.target[5:]) == [1, 3]


def test_full_table_is_unchanged() -> None:
    table = table_of([0.1] * 4, [1.0] * 4, capacity=4)
    before = table.rows.copy()
    densify(table, SETTINGS, EXTENT_M)
    np.testing.assert_array_equal(table.rows, before)


def test_invisible_gaussian_is_not_densified() -> None:
    table = table_of([0.1], [1.0], capacity=4)
    table.first_moment[:, [GRAD_2D_SUM, GRAD_2D_COUNT]] = 0.0
    densify(table, SETTINGS, EXTENT_M)
    assert table.count == 1


def test_split_follows_the_rotation_of_an_elongated_gaussian() -> None:
    table = table_of([0.1], [1e-3], capacity=2)
    table.rows[:, LOG_SCALE] = np.log([1.0, 1e-3, 1e-3])
    table.rows[:, QUAT] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # 90 degrees about z: x becomes y
    densify(table, SETTINGS, EXTENT_M)
    np.testing.assert_allclose(table.rows[:, MEAN].std(axis=0), [0.0, np.sqrt(1 - 1 / 1.6**2), 0.0], atol=1e-6)


def test_prune_drops_the_transparent() -> None:
    table = table_of([0.1] * 3, [0.0] * 3, capacity=4)
    table.rows[:, OPACITY_LOGIT] = (-6.0, 0.0, -5.0)
    prune(table, SETTINGS)
    assert sorted(table.target.tolist()) == [1, 2]


def test_an_empty_table_survives_both() -> None:
    table = SplatTable(4)
    densify(table, SETTINGS, EXTENT_M)
    prune(table, SETTINGS)
    assert table.count == 0


def test_one_densification_adds_no_more_than_its_growth() -> None:
    table = table_of([0.001] * 40, [1e-3] * 40, capacity=100)
    densify(table, DensitySettings(max_growth=0.1), EXTENT_M)
    assert table.count == 44
