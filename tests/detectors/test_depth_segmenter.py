"""DepthSegmenter on synthetic surfaces: which pixels belong to the mask."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite_detectors.depth_segmenter import DepthSegmenter, DepthSegmenterSettings

BOX = np.array([[30, 20, 70, 60]], np.float32)
THING = (slice(25, 55), slice(35, 65))


def frame(depth_m: np.ndarray, rgb: np.ndarray | None = None) -> Frame:
    height, width = depth_m.shape
    colours = np.full((height, width, 3), 90, np.uint8) if rgb is None else rgb
    return Frame(
        0, 0, colours, depth_m.astype(np.float32), Camera(90, 90, width / 2, height / 2, width, height), np.eye(4)
    )


def object_before_a_wall(near_m: float = 1.0, far_m: float = 1.5) -> np.ndarray:
    depth_m = np.full((80, 100), far_m)
    depth_m[THING] = near_m
    return depth_m


def segment(depth_m, rgb=None, boxes=BOX, settings=None):
    return DepthSegmenter(settings).segment(frame(depth_m, rgb), boxes)


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_an_object_before_a_wall_is_segmented_at_any_distance(scale):
    (mask,) = segment(object_before_a_wall() * scale)
    expected = np.zeros((80, 100), np.bool_)
    expected[THING] = True
    assert np.array_equal(mask, expected)


def test_a_slanted_surface_is_one_surface():
    depth_m = object_before_a_wall(far_m=4.0)
    depth_m[THING] = np.linspace(1.0, 1.4, 30)[None, :]
    (mask,) = segment(depth_m)
    assert mask[THING].all()
    assert mask.sum() == 30 * 30


def test_colour_separates_surfaces_of_equal_depth():
    rgb = np.full((80, 100, 3), 20, np.uint8)
    rgb[THING] = 240
    depth_m = np.ones((80, 100))
    (mask,) = segment(depth_m, rgb)
    assert mask[28:52, 38:62].all()
    assert mask.sum() <= 32 * 32
    (without,) = segment(depth_m, rgb, settings=DepthSegmenterSettings(colour_step=1000.0))
    assert without.sum() == 40 * 40


def test_the_mask_stays_in_its_box_and_in_the_image():
    boxes = np.array([[-20, -20, 15, 12], [90, 70, 140, 95]], np.float32)
    for mask, box in zip(segment(np.ones((80, 100)), boxes=boxes), boxes, strict=True):
        left, top = np.maximum(box[:2], 0).astype(int)
        inside = np.zeros((80, 100), np.bool_)
        inside[top : int(box[3]), left : int(box[2])] = True
        assert np.array_equal(mask, inside)


def test_a_large_box_is_scaled_down_and_its_mask_scaled_back():
    depth_m = np.full((480, 640), 2.0)
    depth_m[120:360, 160:480] = 1.0
    (mask,) = segment(depth_m, boxes=np.array([[100, 60, 540, 420]], np.float32))
    expected = depth_m < 1.5
    assert (mask & expected).sum() / (mask | expected).sum() > 0.95


def test_small_holes_in_the_depth_are_closed():
    depth_m = object_before_a_wall()
    depth_m[40, 50] = 0.0
    (mask,) = segment(depth_m)
    assert mask[40, 50]


def test_without_depth_in_the_centre_there_is_no_mask():
    depth_m = object_before_a_wall(near_m=0.0)
    assert segment(depth_m) == [None]
    outside = np.array([[200, 200, 240, 240], [50, 50, 50, 60]], np.float32)
    assert segment(np.ones((80, 100)), boxes=outside) == [None, None]
