"""Frames of one colour, as of a camera that drops out, train nothing and are reported once."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import wall_frame

from gausslite.domain.frame import ONE_COLOUR, Frame
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings
from gausslite.mission.task_mapper import REPEATED, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.cpu import CpuRasterizer

SIZE = (64, 48)


def of_one_colour(frame: Frame, level: int, noise: float = 0.0) -> Frame:
    noisy = level + np.random.default_rng(0).normal(0.0, noise, frame.rgb.shape)
    return replace(frame, rgb=np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


@pytest.mark.parametrize(("level", "noise"), [(0, 0.0), (2, 1.0), (128, 0.0), (255, 0.0), (16, 1.0)])
def test_an_image_of_one_colour_is_a_defect_and_a_view_is_none(level: int, noise: float) -> None:
    frame = wall_frame(0, SIZE)
    assert frame.defect == ""
    assert of_one_colour(frame, level, noise).defect == ONE_COLOUR
    half = of_one_colour(frame, level, noise).rgb
    half[:, :16] = frame.rgb[:, :16]
    assert replace(frame, rgb=half).defect == ""


def test_a_camera_that_drops_out_changes_no_bit_of_the_map_and_is_reported_once() -> None:
    frames = [wall_frame(index, SIZE, shift_m=0.1 * index) for index in range(4)]

    def mapped(sequence: list[Frame]) -> TaskMapper:
        mapper = GaussianMapper(MapperSettings(max_gaussians=200), CpuRasterizer(threads=1))
        task_mapper = TaskMapper(NoTaskEstimator(), mapper)
        for frame in sequence:
            task_mapper.process(frame)
        return task_mapper

    black = [of_one_colour(frame, 0) for frame in frames]
    with_gap = mapped([frames[0], *black[1:3], frames[3]])
    without = mapped([frames[0], frames[3]])
    assert np.array_equal(with_gap.gaussians().means_m, without.gaussians().means_m)
    assert with_gap.notes == (f"frames are skipped in which {ONE_COLOUR}; the first one is 1",)
    assert without.notes == ()


def test_a_camera_that_repeats_its_image_while_the_robot_moves_is_skipped() -> None:
    first = wall_frame(0, SIZE)
    task_mapper = TaskMapper(
        NoTaskEstimator(), GaussianMapper(MapperSettings(max_gaussians=200), CpuRasterizer(threads=1))
    )
    moved = first.T_world_camera.copy()
    moved[0, 3] += 0.1
    frames = [first, replace(first, index=1), replace(first, index=2, T_world_camera=moved), wall_frame(3, SIZE)]
    skipped = [task_mapper.process(frame).skipped for frame in frames]
    assert skipped == [None, None, REPEATED, None]
    assert task_mapper.notes == (f"frames are skipped in which {REPEATED}; the first one is 2",)
