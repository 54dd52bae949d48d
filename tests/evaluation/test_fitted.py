"""Held-out views are scored at fitted poses: of the whole image, or of the region alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame

from gausslite.domain.frame import Frame
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings, OptimizationSettings
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_evaluation.metrics import psnr
from gausslite_evaluation.views import HeldOutView, render_fitted, render_fitted_at_region

SIZE = (96, 72)


@pytest.fixture(scope="module")
def viewer() -> MapViewer:
    rasterizer = CpuRasterizer(threads=1)
    settings = MapperSettings(8_000, optimization=OptimizationSettings(warmup_iterations=20, active_iterations=0))
    mapper = GaussianMapper(settings, rasterizer, seed=0)
    for index in range(3):
        frame = wall_frame(index, SIZE)
        mapper.map_frame(frame, middle_relevance(frame))
    return MapViewer(mapper.gaussians(), rasterizer)


def shifted(frame: Frame, shift_m: float) -> Frame:
    T_world_camera = frame.T_world_camera.copy()
    T_world_camera[1, 3] += shift_m
    return replace(frame, T_world_camera=T_world_camera)


@pytest.mark.parametrize("shift_m", [0.0, 0.02])
def test_a_fit_at_the_region_scores_the_region_at_least_as_well(viewer: MapViewer, shift_m: float) -> None:
    frame = shifted(wall_frame(9, SIZE), shift_m)
    view = HeldOutView(frame, middle_relevance(frame).roi)
    of_region = psnr(render_fitted_at_region(viewer, view).rgb, frame.rgb, view.roi)
    of_image = psnr(render_fitted(viewer, frame).rgb, frame.rgb, view.roi)
    assert of_region >= of_image - 1e-6


def test_a_fit_at_the_region_ignores_what_moved_elsewhere(viewer: MapViewer) -> None:
    frame = wall_frame(9, SIZE)
    roi = middle_relevance(frame).roi
    rows, columns = np.nonzero(roi)
    far = np.ones_like(roi)
    far[rows.min() - 12 : rows.max() + 13, columns.min() - 12 : columns.max() + 13] = False
    moved = np.where(far[..., None], np.roll(frame.rgb, 4, axis=1), frame.rgb)
    changed = HeldOutView(replace(frame, rgb=moved), roi)
    of_region = psnr(render_fitted_at_region(viewer, changed).rgb, moved, roi)
    of_image = psnr(render_fitted(viewer, changed.frame).rgb, moved, roi)
    assert of_region > of_image
