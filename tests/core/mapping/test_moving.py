"""Things that move: found where earlier frames saw through their place, and left out of the map."""

from itertools import pairwise

import numpy as np
import pytest
from mapping_scenes import middle_relevance

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.mapping.mapper import FrameView, GaussianMapper
from gausslite.mapping.moving import moving_pixels
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, OptimizationSettings
from gausslite.mapping.stages import CountedScheduler
from gausslite.mission.build import build_mapper, region_estimator
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import MOVING, TaskMapper
from gausslite.render.cpu import CpuRasterizer
from gausslite_sim.home_settings import HomeSettings

CAMERA = Camera(160.0, 160.0, 80.0, 60.0, 160, 120)
WALL_M, BOX_M = 2.0, 1.2


def frame(index: int, left_px: int | None, x_m: float = 0.0) -> Frame:
    """A wall, and a box in front of it whose left side is in this column; None: no box."""
    depth_m = np.full((120, 160), WALL_M, np.float32)
    # a shade, because an image of one colour is a defect
    rgb = np.broadcast_to(np.linspace(100, 140, 160).astype(np.uint8)[None, :, None], (120, 160, 3)).copy()
    if left_px is not None:
        depth_m[30:90, left_px : left_px + 40] = BOX_M
        rgb[30:90, left_px : left_px + 40] = (200, 60, 30)
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x_m
    return Frame(index, index * 10**8, rgb, depth_m, CAMERA, T_world_camera)


def uniform_mapper() -> TaskMapper:
    return TaskMapper(region_estimator([]), build_mapper(MissionSettings(max_gaussians=3000, iterations=1, threads=1)))


def test_what_stands_where_two_earlier_frames_saw_through_moves() -> None:
    moving = moving_pixels(frame(2, 80), [frame(0, 10), frame(1, 20)])
    assert moving[32:88, 82:118].all()
    assert not moving[:, :72].any()
    assert not moving[:, 128:].any()
    assert not moving_pixels(frame(2, 80), [frame(1, 20)]).any(), "one frame may err"


def test_a_place_that_was_not_seen_or_that_stays_occupied_shows_no_motion() -> None:
    still = [frame(0, 80), frame(1, 80)]
    assert not moving_pixels(frame(2, 80), still).any()
    elsewhere = [frame(0, None, x_m=9.0), frame(1, None, x_m=9.0)]
    assert not moving_pixels(frame(2, 80), elsewhere).any()
    without_depth = [frame(index, None) for index in (0, 1)]
    for earlier in without_depth:
        earlier.depth_m[:] = 0.0
    assert not moving_pixels(frame(2, 80), without_depth).any()


def test_a_thing_that_moves_is_neither_seeded_nor_kept_in_a_keyframe() -> None:
    mapper = uniform_mapper()
    for index in range(12):
        mapper.process(frame(index, None if index < 6 else 20 * (index - 6)))
    assert (mapper.gaussians().means_m[:, 2] > (WALL_M + BOX_M) / 2).all()
    for keyframe in mapper.keyframes():
        depths_m = keyframe.frame.depth_m[32:88]
        assert np.count_nonzero((depths_m > 0) & (depths_m < WALL_M)) < 0.01 * depths_m.size


def test_a_frame_in_which_everything_moves_is_skipped() -> None:
    mapper = uniform_mapper()
    for index in range(6):
        mapper.process(frame(index, None))
    close = frame(6, None)
    close.depth_m[:] = BOX_M
    outcome = mapper.process(close)
    assert (outcome.skipped, outcome.iterations) == (MOVING, 0)
    assert len(mapper.poses) == 6
    assert mapper.notes == ("frames are skipped in which everything moves; the first one is 6",)
    assert mapper.process(frame(7, None)).skipped is None


def test_a_keyframe_loses_what_has_left_its_place_later() -> None:
    mapper = uniform_mapper()
    for index in range(20):
        mapper.process(frame(index, 80 if index == 0 else None))
    first = mapper.keyframes()[0].frame
    assert first.index == 0
    assert not first.depth_m[32:88, 82:118].any()
    assert (mapper.gaussians().means_m[:, 2] > (WALL_M + BOX_M) / 2).all(), "a thing left Gaussians behind"


@pytest.mark.parametrize("half_size_from_px", [10**6, 1])
def test_the_colours_of_pixels_that_are_left_out_have_no_influence_on_the_map(half_size_from_px: int) -> None:
    keyframes, iterations = (
        KeyframeSettings(half_size_from_px=half_size_from_px),
        OptimizationSettings().with_iterations(8),
    )
    settings = MapperSettings(max_gaussians=3000, keyframes=keyframes, optimization=iterations)
    left_out, maps = np.zeros((120, 160), np.bool_), []
    left_out[20:100, 40:100] = True
    for level in (0, 255):
        mapper, coloured = GaussianMapper(settings, CpuRasterizer(threads=1)), frame(0, None)
        coloured.rgb[22:98, 42:98] = level  # seeds depend on the edges beside them
        for shown in (coloured.without(left_out), frame(1, None)):
            mapper.map_view(FrameView(shown), middle_relevance(shown), CountedScheduler())
        assert not mapper.store.kept[0].relevance.roi[left_out].any()
        maps.append(mapper.table.rows.tobytes())
    assert maps[0] == maps[1]


def test_a_simulated_home_has_a_box_that_moves() -> None:
    empty, visited = (open_source(f"sim:home?frames=20&size=64x48&noise=0&movers={count}") for count in (0, 1))
    changed = [empty.frame(i).depth_m != visited.frame(i).depth_m for i in (5, 10, 15)]
    assert sum(map(np.count_nonzero, changed)) > 100
    assert any((a != b).any() for a, b in pairwise(changed))
    pytest.raises(DatasetError, HomeSettings.parse, "movers=2").match("movers: expected 0 or 1, got 2")
