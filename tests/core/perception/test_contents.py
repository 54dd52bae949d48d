"""What a container holds belongs to its mask."""

from __future__ import annotations

import numpy as np
import pytest

from gausslite.perception.contents import with_contents


def bowl_and_fruit() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A disc at 1.5 m with a smaller disc in it, 2 cm nearer, that touches its upper edge, before a wall at 3 m."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    bowl = np.hypot(columns - 80, rows - 60) < 40
    fruit = np.hypot(columns - 80, rows - 42) < 21
    depth_m = np.where(bowl, 1.5, 3.0)
    depth_m[fruit & bowl] = 1.48
    return bowl & ~fruit, bowl, depth_m.astype(np.float32)


@pytest.mark.parametrize(("phrase", "is_whole"), [("bowl", True), ("fruit basket", True), ("plate", False)])
def test_fruit_belongs_to_the_bowl(phrase, is_whole):
    mask, whole, depth_m = bowl_and_fruit()
    result = with_contents(phrase, mask, depth_m)
    assert result[mask].all()
    assert bool(result[whole].mean() > 0.98) is is_whole
    assert not result[~whole].any()


def test_what_is_behind_or_in_front_of_a_container_is_left_out():
    mask, whole, depth_m = bowl_and_fruit()
    other = whole & ~mask
    for distance_m in (1.0, 2.0, 0.0):
        depth_m[other] = distance_m
        assert np.array_equal(with_contents("bowl", mask, depth_m), mask)
    empty = np.zeros_like(mask)
    assert np.array_equal(with_contents("bowl", empty, depth_m), empty)
