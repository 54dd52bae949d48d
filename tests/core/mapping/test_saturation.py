"""Iterations that a saturated region does not use train whole images."""

import math
from contextlib import AbstractContextManager

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import disable
from gausslite.mapping.settings import MapperSettings, SaturationSettings
from gausslite.mapping.stages import CountedScheduler, Stage
from gausslite.mapping.training import RegionSaturation
from gausslite.render.cpu import CpuRasterizer

SETTINGS = SaturationSettings(max_released=0.75, improving=0.12, saturated=0.04)


def visited(improvement: float, visits: int = 60, settings: SaturationSettings = SETTINGS) -> RegionSaturation:
    """Return a measurement of two views whose log loss falls by this amount per visit."""
    saturation = RegionSaturation(settings)
    for visit in range(visits):
        for view in range(2):
            saturation.observe(wall_frame(view).id, (1 + view) * math.exp(-improvement * visit))
    return saturation


@pytest.mark.parametrize(("improvement", "share"), [(0.2, 0.0), (0.12, 0.0), (0.08, 0.375), (0.04, 0.75), (0.0, 0.75)])
def test_the_released_share_grows_as_the_region_stops_improving(improvement: float, share: float) -> None:
    assert visited(improvement).released_share == pytest.approx(share, abs=1e-6)


def test_a_new_region_counts_as_improving_until_its_views_were_visited_again() -> None:
    assert visited(0.0, visits=16).released_share == 0.0
    assert visited(0.0, visits=17).released_share == SETTINGS.max_released


def test_views_are_compared_with_themselves_alone() -> None:
    # an easy and a hard view in turn: the loss alternates, but neither view improves
    assert visited(0.0).released_share == SETTINGS.max_released
    saturation = RegionSaturation(SETTINGS)
    for index in range(60):  # each view once: nothing to compare with
        saturation.observe(wall_frame(index).id, 1.0)
    assert saturation.released_share == 0.0


def test_released_iterations_add_up_to_the_share() -> None:
    saturation = visited(0.08)
    released = [saturation.releases_next() for _ in range(80)]
    assert sum(released) == pytest.approx(0.375 * 80, abs=1)
    assert sum(released[:16]) == pytest.approx(6, abs=1)


def test_a_new_task_starts_again() -> None:
    saturation = visited(0.0)
    saturation.reset()
    assert saturation.released_share == 0.0
    assert not saturation.releases_next()


@pytest.mark.parametrize("loss", [0.0, math.nan, math.inf, -1.0])
def test_a_loss_without_logarithm_is_ignored(loss: float) -> None:
    saturation = visited(0.08)
    before = saturation.released_share
    saturation.observe(wall_frame(0).id, loss)
    assert saturation.released_share == before


def test_a_restored_measurement_continues_alike() -> None:
    saturation, restored = visited(0.07), RegionSaturation(SETTINGS)
    saturation.releases_next()
    restored.restore(saturation.state())
    for each in (saturation, restored):
        each.observe(wall_frame(1).id, 0.5)
    assert restored.released_share == saturation.released_share
    assert [restored.releases_next() for _ in range(9)] == [saturation.releases_next() for _ in range(9)]


def test_a_damaged_state_is_refused() -> None:
    state = dict(visited(0.07).state())
    state["losses"] = -np.asarray(state["losses"])
    pytest.raises(MapFileError, RegionSaturation(SETTINGS).restore, state).match("state saturation")


class CountingScheduler(CountedScheduler):
    """Counts the iterations of each stage."""

    def __init__(self, counts: dict[Stage, int]) -> None:
        super().__init__()
        self._counts = counts

    def timing(self, stage: Stage) -> AbstractContextManager[None]:
        self._counts[stage] = self._counts.get(stage, 0) + 1
        return super().timing(stage)


def counts_of(settings: MapperSettings, frames: list[Frame]) -> dict[Stage, int]:
    counts: dict[Stage, int] = {}
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for frame in frames:
        map_frame(mapper, frame, scheduler=CountingScheduler(counts))
    return counts


def test_a_mapper_trains_whole_images_more_often_once_its_region_is_saturated() -> None:
    frames = [wall_frame(index) for index in range(24)]
    settings = MapperSettings(max_gaussians=2_000, saturation=SETTINGS)
    released, kept = counts_of(settings, frames), counts_of(disable(settings, ["saturation"]), frames)
    assert kept[Stage.WARM_UP] == 2 * len(frames)
    assert released[Stage.WARM_UP] > kept[Stage.WARM_UP]
    assert released[Stage.ACTIVE] > 0
    assert released[Stage.WARM_UP] + released[Stage.ACTIVE] == 8 * len(frames)
