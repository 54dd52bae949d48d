"""Detections of two nouns that share pixels: which of them locate an object."""

from __future__ import annotations

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection
from gausslite.perception.lifting import lift_detections
from gausslite.perception.object_map import Landmark

CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)


def mask_of(*columns: int) -> np.ndarray:
    mask = np.zeros((120, 160), np.bool_)
    mask[40:80, columns[0] : columns[1]] = True
    return mask


def detection(noun: str, *columns: int) -> Detection:
    return Detection(noun, 0.9, (columns[0], 40.0, columns[1], 80.0), mask_of(*columns))


def widths_m(*detections: Detection) -> list[tuple[float, float]]:
    """Return the first and last x of the cells of each detection, 2 m before the camera."""
    depth_m = np.full((120, 160), 2.0, np.float32)
    frame = Frame(0, 0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, np.eye(4))
    boxes = [Landmark.from_observation(each).box_m() for _, each in lift_detections(detections, depth_m, frame)]
    return [(box.min_m[0], box.max_m[0]) for box in boxes]


def test_pixels_that_two_nouns_claim_locate_neither_object():
    chair, table = (
        detection("chair", 40, 80),
        detection("table", 70, 130),
    )
    (chair_low_m, chair_high_m), (table_low_m, table_high_m) = widths_m(chair, table)
    assert (chair_low_m, chair_high_m) == pytest.approx((-0.8, -0.2), abs=0.06)
    assert (table_low_m, table_high_m) == pytest.approx((0.0, 1.0), abs=0.06)


def test_an_object_inside_the_mask_of_another_is_located_by_all_its_pixels():
    mug, table = detection("mug", 80, 100), detection("table", 40, 120)
    ((mug_low_m, mug_high_m), _) = widths_m(mug, table)
    assert (mug_low_m, mug_high_m) == pytest.approx((0.0, 0.4), abs=0.06)


def test_two_detections_of_one_noun_keep_the_pixels_they_share():
    left, right = detection("chair", 40, 80), detection("chair", 70, 130)
    ((low_m, high_m), _) = widths_m(left, right)
    assert (low_m, high_m) == pytest.approx((-0.8, 0.0), abs=0.06)
