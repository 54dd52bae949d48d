"""Views train in turn: new ones first, then those that waited longest; active iterations fill one image's tiles."""

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from mapping_scenes import map_frame, middle_relevance, wall_frame

from gausslite.domain.errors import MapFileError
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, OptimizationSettings
from gausslite.mapping.view_rotation import ViewRotation
from gausslite.mapping.window_view import WindowView, window_view
from gausslite.render.cpu import CpuRasterizer, CpuView
from gausslite.render.rasterizer import StepReport


def prepared(index: int) -> WindowView:
    frame = wall_frame(index, shift_m=0.1 * index)
    return window_view(Keyframe(frame, middle_relevance(frame)), CpuRasterizer(threads=1), KeyframeSettings())


VIEWS = [prepared(index) for index in range(5)]


def visited(rotation: ViewRotation, views: list[WindowView], count: int) -> list[int]:
    return [view.keyframe.frame.index for view in islice(rotation.turns(views), count)]


def test_new_views_come_first_then_those_that_waited_longest() -> None:
    rotation = ViewRotation()
    assert visited(rotation, VIEWS[:3], 2) == [2, 1]
    assert visited(rotation, VIEWS, 3) == [4, 3, 0]
    assert visited(rotation, VIEWS, 7) == [2, 1, 4, 3, 0, 2, 1]


def test_a_view_with_a_refined_pose_is_the_same_view() -> None:
    rotation = ViewRotation()
    visited(rotation, VIEWS, 5)
    old = VIEWS[4].keyframe
    moved = replace(old.frame, T_world_camera=wall_frame(4, shift_m=0.5).T_world_camera)
    refined = replace(VIEWS[4], keyframe=replace(old, frame=moved, recorded=old.frame))
    assert visited(rotation, [*VIEWS[:4], refined], 5) == [4, 3, 2, 1, 0]
    assert visited(rotation, [*VIEWS[:3], refined, VIEWS[3]], 1) == [4]


def test_a_restored_rotation_continues_alike_and_refuses_a_damaged_state() -> None:
    rotation, restored = ViewRotation(), ViewRotation()
    visited(rotation, VIEWS, 3)
    restored.restore(rotation.state())
    assert visited(restored, VIEWS, 9) == visited(rotation, VIEWS, 9)
    pytest.raises(MapFileError, restored.restore, {"views": np.array([7, 7], np.int64)}).match("views")


class StepRecorder(CpuRasterizer):
    """Records the width and the dilation of the image of each step."""

    def __init__(self) -> None:
        super().__init__(threads=1)
        self.steps: list[tuple[int, float]] = []

    def step(self, *arguments: Any, **options: Any) -> StepReport:
        view: CpuView = arguments[3]
        self.steps.append((view.camera.width_px, view.dilation_px2))
        return super().step(*arguments, **options)


def test_an_iteration_on_large_whole_images_trains_four_in_half_size() -> None:
    rasterizer = StepRecorder()
    settings = MapperSettings(
        500,
        keyframes=KeyframeSettings(half_size_from_px=161 * 120),
        optimization=OptimizationSettings(warmup_iterations=2, active_iterations=0),
    )
    for size in ((161, 120), (160, 120)):
        frame = wall_frame(size=size)
        map_frame(GaussianMapper(settings, rasterizer, seed=0), frame)
    # 0.3 px², and 1/4 px² of the mean over 2x2 pixels, in pixels of twice the side
    assert rasterizer.steps == [(80, pytest.approx(0.1375))] * 8 + [(160, 0.3)] * 2


@pytest.mark.parametrize(("share", "steps"), [(0.15, 4), (0.4, 2), (0.9, 1)])
def test_an_active_iteration_trains_as_many_views_as_fit_in_one_image(share: float, steps: int) -> None:
    optimization = OptimizationSettings(warmup_iterations=0, active_iterations=1, active_views=4)
    mapper = GaussianMapper(MapperSettings(500, optimization=optimization), CpuRasterizer(threads=1), seed=0)
    frame = wall_frame(size=(160, 160))
    relevance = middle_relevance(frame)
    relevance.pixel_weights[:] = 0
    relevance.pixel_weights[: int(160 * share)] = 1
    relevance.target[:] = np.where(relevance.pixel_weights > 0, 0, -1)
    map_frame(mapper, frame, relevance)
    assert mapper.gaussians().kappa.max() == steps
