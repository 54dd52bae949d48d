"""Wrong depth beside a depth jump does not reach the training."""

from dataclasses import replace

import numpy as np
import pytest
from cpu_scenes import random_rows
from mapping_scenes import middle_relevance, wall_frame

from gausslite.domain.frame import Frame
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.settings import ONLINE_RATES, KeyframeSettings
from gausslite.mapping.window_view import window_view
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import LossWeights


def box_frame(border_m: float) -> Frame:
    """A box at 1 m in columns 10 to 29, a wall at 2 m around it, and column 30 as stated. Column 32 has no depth."""
    frame = wall_frame()
    depth_m = frame.depth_m.copy()
    depth_m[:, 10:30], depth_m[:, 30], depth_m[:, 32] = 1.0, border_m, 0.0
    return replace(frame, depth_m=depth_m)


def trained_rows(frame: Frame, depth_edge_px: int) -> np.ndarray:
    """Return random Gaussians after one step with this frame."""
    rasterizer = CpuRasterizer(threads=1)
    view = window_view(
        Keyframe(frame, middle_relevance(frame)), rasterizer, KeyframeSettings(depth_edge_px=depth_edge_px)
    )
    rows = random_rows(2000)
    first, second = np.zeros_like(rows), np.zeros_like(rows)
    only_depth = LossWeights(colour=0.0, depth=1.0, ssim=0.0, normalise_by_image=True)
    rasterizer.step(rows, first, second, view.training_view, np.eye(4), only_depth, ONLINE_RATES)
    return rows


@pytest.mark.parametrize(("depth_edge_px", "is_reached"), [(0, True), (2, False)])
def test_a_column_between_two_surfaces_changes_nothing(depth_edge_px: int, is_reached: bool) -> None:
    exact, mixed = (trained_rows(box_frame(border_m), depth_edge_px) for border_m in (2.0, 1.5))
    assert np.array_equal(exact, mixed) != is_reached
