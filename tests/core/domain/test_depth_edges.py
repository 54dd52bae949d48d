"""Depth is left out beside jumps only."""

import numpy as np
import pytest

from gausslite.domain.frame import without_depth_edges


def step(width_px: int = 12) -> np.ndarray:
    """Two walls at 1 m and 2 m that meet between columns 5 and 6."""
    depth_m = np.full((8, width_px), 2.0, np.float32)
    depth_m[:, :6] = 1.0
    return depth_m


@pytest.mark.parametrize("distance_px", [0, 1, 2, 3])
def test_both_sides_of_a_jump_are_left_out_up_to_the_distance(distance_px: int) -> None:
    kept = without_depth_edges(step(), distance_px) > 0
    columns = np.flatnonzero(~kept[4])
    assert columns.tolist() == list(range(6 - distance_px, 6 + distance_px))
    assert (kept == kept[4]).all()


def test_slopes_and_small_steps_are_kept() -> None:
    columns = np.arange(12, dtype=np.float32)
    slope = np.tile(1.0 + 0.01 * columns, (8, 1))
    np.testing.assert_array_equal(without_depth_edges(slope, 2), slope)
    small = np.where(step() > 1, np.float32(1.03), np.float32(1.0))
    np.testing.assert_array_equal(without_depth_edges(small, 2), small)


def test_missing_depth_is_no_jump_and_the_input_stays() -> None:
    depth_m = np.full((8, 12), 1.5, np.float32)
    depth_m[2:5, 3:7] = 0.0
    before = depth_m.copy()
    np.testing.assert_array_equal(without_depth_edges(depth_m, 2), before)
    step_m = step()
    without_depth_edges(step_m, 2)
    np.testing.assert_array_equal(step_m, step())
