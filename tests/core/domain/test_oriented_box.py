"""The oriented box of an object: that of its own Gaussians, whatever else is in the box of its cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import plain_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole, OrientedBox, oriented_box
from gausslite.domain.voxels import AxisAlignedBox

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


def mug_on_a_table() -> Gaussians:
    """A mug of 8 cm (target 1), turned by 30 degrees, with one stray Gaussian; a plate (0); the table (none)."""
    turn = math.radians(30)
    x, y, z = np.random.default_rng(0).uniform(-0.04, 0.04, (3, 400))
    mug = np.stack([x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn), z], axis=1)
    others = np.random.default_rng(1).uniform(-0.12, 0.12, (300, 3))
    means_m = np.concatenate([mug, [[0.11, 0.0, 0.0]], others])
    target = np.repeat([1, 1, 0, -1], [400, 1, 150, 150])
    return plain_gaussians(means_m, target=target, active=target >= 0)


def landmark(noun: str, role: ObjectRole) -> ObjectLandmark:
    extent = AxisAlignedBox((-0.125, -0.125, -0.125), (0.125, 0.125, 0.125))
    return ObjectLandmark(f"{noun}-1", noun, role, (0.0, 0.0, 0.0), extent, 1.0, 0, 1)


def test_an_object_is_as_large_as_its_own_gaussians() -> None:
    mug = landmark("mug", ObjectRole.TARGET)
    box = oriented_box(mug, mug_on_a_table(), ("plate", "mug_2"), UP_AXES[0])
    assert box is not None
    assert box.size_m == pytest.approx((0.08, 0.08, 0.08), abs=0.006)
    assert math.degrees(box.yaw_rad) % 90 == pytest.approx(30, abs=5)


def test_an_object_without_gaussians_of_its_own_has_no_such_box() -> None:
    assert oriented_box(landmark("table", ObjectRole.ANCHOR), mug_on_a_table(), ("mug",), UP_AXES[0]) is None
    assert oriented_box(landmark("table", ObjectRole.ANCHOR), mug_on_a_table(), (), UP_AXES[0]) is None
    assert oriented_box(landmark("mug", ObjectRole.TARGET), Gaussians.empty(), ("mug",), UP_AXES[0]) is None
