"""Exponential moving average (EMA) of the rows, which exported maps contain."""

import math

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame
from numpy.testing import assert_allclose, assert_array_equal

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.density import densify
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import DensitySettings, MapperSettings, OptimizationSettings, SeedingSettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, RGB, UPDATE_COUNT

HORIZON = 40.0
UPDATES_PER_STEP = 8


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


def oscillate(table: SplatTable, steps: int, horizon: float = HORIZON, amplitude: float = 0.1) -> None:
    """Change colours randomly around their initial values, as inconsistent views do."""
    rng, initial_rgb = np.random.default_rng(1), table.rows[:, RGB].copy()
    for _ in range(steps):
        table.rows[:, RGB] = initial_rgb + rng.normal(0, amplitude, initial_rgb.shape)
        table.rows[:, UPDATE_COUNT] += UPDATES_PER_STEP
        table.update_ema(horizon)


def test_ema_of_new_and_of_constant_rows_is_the_row() -> None:
    table = table_of(20)
    assert_array_equal(table.ema_rows, table.rows)
    oscillate(table, steps=50, amplitude=0.0)
    assert_allclose(table.ema_rows, table.rows, rtol=1e-6)


def test_ema_error_decreases_with_the_horizon() -> None:
    mean_rgb, errors = table_of(300).rows[:, RGB], []
    for horizon in (4.0, 16.0, 64.0):
        table = table_of(300)
        oscillate(table, steps=100, horizon=horizon)
        errors.append(float(np.abs(table.ema_rows[:, RGB] - mean_rgb).mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.parametrize("steps", [[80], [8] * 10, [1] * 80])
def test_ema_depends_on_updates_not_on_calls(steps: list[int]) -> None:
    table = table_of(5)
    table.rows[:, UPDATE_COUNT] = table.ema_rows[:, UPDATE_COUNT] = 10 * HORIZON
    before = table.rows[:, RGB].copy()
    table.rows[:, RGB] += 1.0
    for updates in steps:
        table.rows[:, UPDATE_COUNT] += updates
        table.update_ema(HORIZON)
    assert_allclose(table.ema_rows[:, RGB] - before, 1.0 - math.exp(-80 / HORIZON), rtol=1e-4)


def test_ema_follows_rows_with_few_updates() -> None:
    table = table_of(5)
    initial = table.rows[:, RGB].copy()
    table.rows[:, RGB] += 1.0
    table.rows[:, UPDATE_COUNT] += UPDATES_PER_STEP
    table.update_ema(1000.0)
    assert (table.ema_rows[:, RGB] - initial > 0.8).all()


def test_ema_of_unchanged_rows_is_constant() -> None:
    table = table_of(20)
    oscillate(table, steps=10)
    before = table.ema_rows.copy()
    table.rows[5:, UPDATE_COUNT] += UPDATES_PER_STEP
    table.update_ema(HORIZON)
    assert_array_equal(table.ema_rows[:5], before[:5])


def test_ema_moves_with_its_row() -> None:
    table = table_of(20)
    oscillate(table, steps=10)
    table.kappa[:] = np.arange(20)
    ema = table.ema_rows.copy()
    table.keep(np.random.default_rng(2).random(20) < 0.5)
    assert_array_equal(table.ema_rows, ema[table.kappa])
    new = table_of(3).to_gaussians()
    table.replace(np.arange(3), new)
    assert_array_equal(table.ema_rows[:3], table.rows[:3])
    table_copy = SplatTable(40)
    table_copy.restore(table.state())
    copy_smoothed, smoothed = table_copy.to_gaussians(use_ema=True), table.to_gaussians(use_ema=True)
    assert_array_equal(copy_smoothed.rgb, smoothed.rgb)


@pytest.mark.parametrize("percent_dense", [0.0, 1.0])
def test_averages_of_clones_and_halves_are_those_of_the_parents_average(percent_dense: float) -> None:
    table, averages = table_of(20), table_of(20)
    oscillate(table, steps=10)
    averages.rows[:] = table.ema_rows
    for one in (table, averages):
        one.first_moment[:, GRAD_2D_SUM] = one.first_moment[:, GRAD_2D_COUNT] = 1.0
        densify(one, DensitySettings(percent_dense=percent_dense, max_growth=1.0), extent_m=1.0)
    assert_array_equal(table.rows[:, UPDATE_COUNT] == 0, np.arange(40) >= (20 if percent_dense else 0))
    assert_array_equal(table.ema_rows, averages.rows)


def map_of(ema_updates: float) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=400,
        seeding=SeedingSettings(later_seeds=20_000),
        optimization=OptimizationSettings(ema_updates=ema_updates),
    )
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(4):
        frame = wall_frame(index, (48, 32), shift_m=0.1 * index)
        map_frame(mapper, frame)
    return mapper


def test_training_is_independent_of_the_ema() -> None:
    without_ema, with_ema = map_of(0.0), map_of(HORIZON)
    frame = wall_frame(0, (48, 32))
    renderings = [mapper.render(frame.camera, frame.T_world_camera).rgb for mapper in (without_ema, with_ema)]
    assert_array_equal(*renderings)
    current, smoothed = without_ema.gaussians(), with_ema.gaussians()
    assert len(current) == len(smoothed)
    assert np.abs(current.rgb - smoothed.rgb).max() > 1e-3
    assert_array_equal(with_ema.gaussians(active_only=True).rgb, smoothed.rgb[smoothed.active])


def test_each_step_of_the_region_enters_the_ema(monkeypatch: pytest.MonkeyPatch) -> None:
    averaged: list[int] = []
    update_ema = SplatTable.update_ema

    def counted(table: SplatTable, horizon: float, rows: np.ndarray | None = None) -> None:
        averaged.append(int((table.rows[:, UPDATE_COUNT] - table.ema_rows[:, UPDATE_COUNT]).max()))
        update_ema(table, horizon, rows)

    monkeypatch.setattr(SplatTable, "update_ema", counted)
    map_of(HORIZON)
    # the updates of two warm-up iterations and of one step
    assert max(averaged) <= 3
