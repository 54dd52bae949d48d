"""The smallest upright box around points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite_view.oriented_box import OrientedBox

UP_AXES = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))
sides = st.floats(0.05, 3.0)


@given(st.tuples(sides, sides, sides), st.floats(-1.5, 1.5), st.tuples(*[st.floats(-1e4, 1e4)] * 3))
@pytest.mark.parametrize("up_axis", UP_AXES)
def test_the_corners_of_a_box_are_enclosed_by_this_box(up_axis, size_m, yaw_rad, centre_m) -> None:
    vertical = int(np.argmax(np.abs(up_axis)))
    corners_m = OrientedBox(centre_m, yaw_rad, size_m, vertical).corners_m
    found = OrientedBox.enclosing(corners_m, up_axis)
    assert found.size_m == pytest.approx((*sorted(size_m[:2], reverse=True), size_m[2]), abs=1e-3)
    assert np.abs(found.corners_m[:, None] - corners_m).sum(axis=2).min(axis=1).max() < 5e-3
