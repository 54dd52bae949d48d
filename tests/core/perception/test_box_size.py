"""The limits of a box's size: in metres where depth is known, in shares of the image elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.perception.box_size import BoxSizeLimits, box_extent_m

CAMERA = Camera(100.0, 100.0, 100.0, 75.0, 200, 150)
WHOLE_IMAGE = (0.0, 0.0, 200.0, 150.0)


def frame_at(depth_m: float) -> Frame:
    return Frame(0, 0, np.zeros((150, 200, 3), np.uint8), np.full((150, 200), depth_m, np.float32), CAMERA, np.eye(4))


@pytest.mark.parametrize("depth_m", [0.4, 1.0, 2.5])
def test_the_extent_is_the_longer_side_at_the_measured_depth(depth_m):
    assert box_extent_m((20.0, 30.0, 120.0, 60.0), frame_at(depth_m)) == pytest.approx(depth_m)
    assert box_extent_m((20.0, 30.0, 40.0, 110.0), frame_at(depth_m)) == pytest.approx(0.8 * depth_m)


def test_a_near_object_may_fill_the_image_and_a_far_one_may_not():
    limits = BoxSizeLimits()
    assert limits.accepts("mug", 0.5, WHOLE_IMAGE, frame_at(0.4))
    assert not limits.accepts("mug", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("chair", 0.5, WHOLE_IMAGE, frame_at(0.5))
    assert not limits.accepts("chair", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("couch", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("table", 0.5, WHOLE_IMAGE, frame_at(2.5))
    assert not limits.accepts("wardrobe", 0.5, WHOLE_IMAGE, frame_at(2.5))


def test_a_confident_detection_may_be_larger():
    accepted = [BoxSizeLimits().accepts("monitor", score, WHOLE_IMAGE, frame_at(0.7)) for score in (0.3, 0.6, 0.8)]
    assert accepted == [False, False, True]


def test_the_nearer_part_of_a_box_counts():
    frame = frame_at(4.0)
    frame.depth_m[:75] = 0.4
    assert box_extent_m(WHOLE_IMAGE, frame) == pytest.approx(0.8)


def test_without_depth_the_share_of_the_image_counts():
    limits, frame = BoxSizeLimits(), frame_at(0.0)
    assert box_extent_m(WHOLE_IMAGE, frame) is None
    assert box_extent_m((300.0, 10.0, 320.0, 20.0), frame) is None
    assert limits.accepts("mug", 0.9, (0.0, 0.0, 60.0, 60.0), frame)
    assert not limits.accepts("mug", 0.9, (0.0, 0.0, 100.0, 100.0), frame)
    assert limits.accepts("bed", 0.9, (0.0, 0.0, 150.0, 150.0), frame)
