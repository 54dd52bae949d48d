"""Properties of the mapper for every combination of its components."""

from itertools import product

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import Components, DensitySettings, KeyframeSettings, MapperSettings, SeedingSettings
from gausslite.render.cpu import CpuRasterizer

SIZE = (32, 24)


@pytest.mark.parametrize(
    "switches", list(product((False, True), repeat=5)), ids=lambda on: "".join("01"[x] for x in on)
)
def test_every_combination_maps_within_the_cap(switches: tuple[bool, ...]) -> None:
    components = Components(*switches)
    settings = MapperSettings(
        max_gaussians=150,
        components=components,
        seeding=SeedingSettings(later_seeds=60_000),
        keyframes=KeyframeSettings(every=1, window=2),
        density=DensitySettings(densify_every=3, prune_every=4),
    )
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(2):
        frame = wall_frame(index, SIZE, shift_m=0.2 * index)
        map_frame(mapper, frame)
        assert 0 < mapper.table.count <= 150
    gaussians = mapper.gaussians()
    assert np.isfinite(gaussians.means_m).all()
    assert gaussians.active.any()
    assert bool(gaussians.kappa.any()) == components.roi
