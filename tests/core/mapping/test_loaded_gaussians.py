"""Gaussians of an earlier map or of the team are trained already: a few views do not ruin them."""

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import RGB, UPDATE_COUNT, gaussians_to_rows

SETTINGS = MapperSettings(max_gaussians=6000)
OTHER = wall_frame(99, (128, 96), shift_m=0.4)


def error_of(gaussians: Gaussians) -> float:
    """Mean squared error of a view that the later frames hardly show."""
    rows, pose = gaussians_to_rows(gaussians), inverse(OTHER.T_world_camera)
    rgb = CpuRasterizer(1).forward(rows, OTHER.camera, pose).rgb
    return float(np.square(rgb - OTHER.rgb / 255.0).mean())


@pytest.fixture(scope="module")
def earlier() -> Gaussians:
    mapper = GaussianMapper(SETTINGS, CpuRasterizer(1))
    for i in range(16):
        map_frame(mapper, wall_frame(i, (128, 96), shift_m=0.04 * i - 0.1))
    return mapper.gaussians()


def test_the_frames_of_a_second_mission_keep_an_earlier_map(earlier: Gaussians) -> None:
    mapper = GaussianMapper(SETTINGS, CpuRasterizer(1), initial_map=earlier)
    for i in range(3):
        map_frame(mapper, wall_frame(i, (128, 96), shift_m=-0.1))
    assert error_of(mapper.gaussians()) < 1.7 * error_of(earlier)


def test_loaded_rows_get_the_median_second_moment_of_trained_ones() -> None:
    table = SplatTable(10)
    table.append(plain_gaussians([(0.1 * i, 0.0, 1.0) for i in range(3)]), anchor=0)
    table.rows[:, UPDATE_COUNT] = [400, 1, 200]
    correction = 1.0 - 0.999 ** np.array([400, 1, 200])
    table.second_moment[:, RGB] = (correction * [2.0, 90.0, 4.0])[:, None]
    table.append(plain_gaussians([(0.5, 0.0, 1.0)]))
    table.adopt(np.array([3]), 2000, beta2=0.999)
    np.testing.assert_allclose(table.second_moment[3, RGB] / (1.0 - 0.999**2000), 3.0, rtol=1e-4)
    assert table.rows[3, UPDATE_COUNT] == table.ema_rows[3, UPDATE_COUNT] == 2000
    assert not table.first_moment[3].any()


def test_without_a_trained_row_nothing_is_adopted() -> None:
    table = SplatTable(10)
    table.append(plain_gaussians([(0.5, 0.0, 1.0)]))
    table.adopt(np.array([0]), 2000, beta2=0.999)
    assert table.rows[0, UPDATE_COUNT] == 0
