"""What is shown of a map is each Gaussian's mean over its latest updates, wherever its row goes meanwhile."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame
from numpy.testing import assert_allclose, assert_array_equal

from gausslite.domain.gaussians import Gaussians
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings, OptimizationSettings, SeedingSettings
from gausslite.optimize.density import DensitySettings, densify
from gausslite.optimize.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, RGB, UPDATE_COUNT

HORIZON = 40.0
UPDATES_A_TURN = 8


def table_of(count: int) -> SplatTable:
    rng = np.random.default_rng(0)
    table = SplatTable(2 * count)
    table.append(
        Gaussians(
            means_m=rng.normal(size=(count, 3)).astype(np.float32),
            quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            scales_m=np.full((count, 3), 0.01, np.float32),
            opacities=np.full(count, 0.5, np.float32),
            rgb=rng.uniform(size=(count, 3)).astype(np.float32),
            active=np.zeros(count, np.bool_),
            kappa=np.zeros(count, np.uint32),
            target=np.full(count, -1, np.int16),
        )
    )
    return table


def swing(table: SplatTable, turns: int, horizon: float = HORIZON, amplitude: float = 0.1) -> None:
    """Colours go to and fro about where they were, as under views that contradict each other."""
    rng, still = np.random.default_rng(1), table.rows[:, RGB].copy()
    for _ in range(turns):
        table.rows[:, RGB] = still + rng.normal(0, amplitude, still.shape)
        table.rows[:, UPDATE_COUNT] += UPDATES_A_TURN
        table.update_ema(horizon)


def test_a_newborn_is_its_own_mean_and_so_is_a_row_that_does_not_move() -> None:
    table = table_of(20)
    assert_array_equal(table.ema_rows, table.rows)
    swing(table, turns=50, amplitude=0.0)
    assert_allclose(table.ema_rows, table.rows, rtol=1e-6)


def test_the_mean_of_rows_that_swing_lies_nearer_to_their_middle_the_farther_it_reaches() -> None:
    middle, errors = table_of(300).rows[:, RGB], []
    for horizon in (4.0, 16.0, 64.0):
        table = table_of(300)
        swing(table, turns=100, horizon=horizon)
        errors.append(float(np.abs(table.ema_rows[:, RGB] - middle).mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.parametrize("turns", [[80], [8] * 10, [1] * 80])
def test_what_counts_is_updates_and_not_how_often_one_asks(turns: list[int]) -> None:
    table = table_of(5)
    table.rows[:, UPDATE_COUNT] = table.ema_rows[:, UPDATE_COUNT] = 10 * HORIZON
    before = table.rows[:, RGB].copy()
    table.rows[:, RGB] += 1.0
    for updates in turns:
        table.rows[:, UPDATE_COUNT] += updates
        table.update_ema(HORIZON)
    assert_allclose(table.ema_rows[:, RGB] - before, 1.0 - math.exp(-80 / HORIZON), rtol=1e-4)


def test_a_young_row_is_not_held_back_by_where_it_was_born() -> None:
    table = table_of(5)
    born = table.rows[:, RGB].copy()
    table.rows[:, RGB] += 1.0
    table.rows[:, UPDATE_COUNT] += UPDATES_A_TURN
    table.update_ema(1000.0)
    assert (table.ema_rows[:, RGB] - born > 0.8).all()


def test_rows_that_no_step_moved_keep_their_mean() -> None:
    table = table_of(20)
    swing(table, turns=10)
    before = table.ema_rows.copy()
    table.rows[5:, UPDATE_COUNT] += UPDATES_A_TURN
    table.update_ema(HORIZON)
    assert_array_equal(table.ema_rows[:5], before[:5])


def test_means_go_where_their_rows_go() -> None:
    table = table_of(20)
    swing(table, turns=10)
    table.kappa[:] = np.arange(20)
    means = table.ema_rows.copy()
    table.keep(np.random.default_rng(2).random(20) < 0.5)
    assert_array_equal(table.ema_rows, means[table.kappa])
    newborn = table_of(3).to_gaussians()
    table.replace(np.arange(3), newborn)
    assert_array_equal(table.ema_rows[:3], table.rows[:3])
    twin = SplatTable(40)
    twin.restore(table.state())
    twin_shown, shown = twin.to_gaussians(use_ema=True), table.to_gaussians(use_ema=True)
    assert_array_equal(twin_shown.rgb, shown.rgb)


@pytest.mark.parametrize("percent_dense", [0.0, 1.0])
def test_clones_and_halves_start_with_means_of_their_own(percent_dense: float) -> None:
    table = table_of(20)
    swing(table, turns=10)
    table.first_moment[:, GRAD_2D_SUM] = table.first_moment[:, GRAD_2D_COUNT] = 1.0
    settings = DensitySettings(percent_dense=percent_dense, max_growth=1.0)
    densify(table, settings, extent_m=1.0)
    young = table.rows[:, UPDATE_COUNT] == 0
    assert young.sum() == (20 if percent_dense else 40)
    assert_array_equal(table.ema_rows[young], table.rows[young])


def map_of(ema_updates: float) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=400,
        seeding=SeedingSettings(later_seeds=20_000),
        optimization=OptimizationSettings(ema_updates=ema_updates),
    )
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(4):
        frame = wall_frame(index, (48, 32), shift_m=0.1 * index)
        mapper.map_frame(frame, middle_relevance(frame))
    return mapper


def test_training_is_the_same_whether_its_mean_is_shown_or_not() -> None:
    plain, averaged = map_of(0.0), map_of(HORIZON)
    frame = wall_frame(0, (48, 32))
    drawn = [mapper.render(frame.camera, frame.T_world_camera).rgb for mapper in (plain, averaged)]
    assert_array_equal(*drawn)
    live, shown = plain.gaussians(), averaged.gaussians()
    assert len(live) == len(shown)
    assert np.abs(live.rgb - shown.rgb).max() > 1e-3
    assert_array_equal(averaged.roi_gaussians().rgb, shown.rgb[shown.active])


@pytest.mark.parametrize("updates", [-1.0, math.nan, math.inf])
def test_a_reach_that_is_none_is_refused(updates: float) -> None:
    with pytest.raises(InvalidInputError, match="ema_updates"):
        replace(OptimizationSettings(), ema_updates=updates)
