"""Settings and arguments of the mapping that are refused by name."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import TASK, disable, policy
from gausslite.mapping.settings import (
    DensitySettings,
    MapperSettings,
    OptimizationSettings,
    SaturationSettings,
    SeedingSettings,
)
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer


def map_with_another_size() -> object:
    mapper = GaussianMapper(MapperSettings(max_gaussians=400), CpuRasterizer(threads=1), 0)
    return map_frame(mapper, wall_frame(0, (48, 32)), RelevanceMap.empty(8, 8))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (map_with_another_size, ShapeError, "relevance pixel_weights"),
        (lambda: policy("best"), InvalidInputError, "policy: expected one of"),
        (
            lambda: disable(policy(TASK), {"sound", "light", "sb"}),
            InvalidInputError,
            r"disable: expected names among sb, .*, got light, sound",
        ),
        *(
            (lambda kind=kind, wrong=wrong: kind(**wrong), InvalidInputError, message or next(iter(wrong)))
            for kind, wrong, message in (
                (SaturationSettings, {"max_released": 1.5}, "saturation"),
                (SaturationSettings, {"improving": 0.01}, "saturation"),
                (SaturationSettings, {"saturated": math.nan}, "saturation"),
                (SeedingSettings, {"roi_share": 1.5}, ""),
                (SeedingSettings, {"opacity": 1.0}, ""),
                (SeedingSettings, {"max_depth_m": 0.0}, ""),
                (SeedingSettings, {"later_seeds": 0}, ""),
                (DensitySettings, {"densify_every": 0}, ""),
                (DensitySettings, {"prune_every": -1}, ""),
                (DensitySettings, {"min_opacity": math.nan}, ""),
            )
        ),
        *(
            (lambda updates=updates: replace(OptimizationSettings(), ema_updates=updates), InvalidInputError, "ema_upd")
            for updates in (-1.0, math.nan, math.inf)
        ),
        *(
            (lambda capacity=capacity: SplatTable(capacity), InvalidInputError, "expected a table that fits in memory")
            for capacity in (10**12, 10**18, 10**30)
        ),
        (lambda: SplatTable(0), InvalidInputError, "capacity"),
        (lambda: SplatTable(3).keep(np.ones(2, np.bool_)), ShapeError, "keep mask"),
    ],
)
def test_a_wrong_value_is_named(call: Callable[[], object], error: type[Exception], message: str) -> None:
    pytest.raises(error, call).match(message)
