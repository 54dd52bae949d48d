"""The loop of one robot, frame in, words out."""

from __future__ import annotations

import numpy as np
import pytest
from mapping_scenes import wall_frame

from gausslite.domain.region import BallRegion
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.roi import RoiLedger
from gausslite.mapping.settings import MapperSettings, SeedingSettings
from gausslite.perception.fixed import NoAttention, RegionAttention
from gausslite.pipeline import TaskMapper
from gausslite.render.cpu import CpuRasterizer

SIZE = (32, 24)
BALL = RegionAttention([BallRegion((0.0, 0.0, 2.0), 0.5)])


def small_mapper() -> GaussianMapper:
    settings = MapperSettings(max_gaussians=200, seeding=SeedingSettings(later_seeds=20_000))
    return GaussianMapper(settings, CpuRasterizer(threads=1))


def test_words_of_all_frames_add_up_to_the_active_part_of_the_map() -> None:
    loop = TaskMapper(BALL, small_mapper(), RoiLedger(VoxelGrid(0.25)))
    counts: dict[int, int] = {}
    for index in range(3):
        outcome = loop.process(wall_frame(index, SIZE, shift_m=0.1 * index))
        assert outcome.words is not None
        counts.update(zip(outcome.words.keys.tolist(), outcome.words.counts.tolist(), strict=True))
    gaussians = loop.gaussians()
    assert sum(counts.values()) == int(gaussians.active.sum()) > 0
    assert (outcome.index, outcome.gaussians, outcome.iterations) == (2, len(gaussians), 8)
    assert 0 < outcome.roi_share < 1
    assert outcome.seconds > 0


def test_without_a_ledger_there_are_no_words() -> None:
    assert TaskMapper(NoAttention(), small_mapper()).process(wall_frame(0, SIZE)).words is None


def test_a_frame_without_depth_is_passed_over() -> None:
    frame = wall_frame(0, SIZE)
    frame.depth_m[:] = 0.0
    outcome = TaskMapper(BALL, small_mapper(), RoiLedger(VoxelGrid())).process(frame)
    assert outcome.skipped == "no pixel has a depth reading"
    assert outcome.words is None
    assert outcome.iterations == 0


def test_time_is_a_budget_for_the_whole_frame() -> None:
    loop = TaskMapper(NoAttention(), small_mapper(), seconds_per_frame=1e-6)
    assert loop.process(wall_frame(0, SIZE)).iterations == 0
    with pytest.raises(InvalidInputError, match="seconds_per_frame"):
        TaskMapper(NoAttention(), small_mapper(), seconds_per_frame=np.nan)
