"""Limits on the size of boxes, and small objects in enlarged tiles."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import Detection
from gausslite_detectors.boxes import BoxSizeLimits
from gausslite_detectors.tiles import Tile, TiledDetector, Tiling, crop, tiles_of

HEIGHT_PX, WIDTH_PX = 60, 80
INPUT_WIDTH_PX = 80
MIN_SIDE_PX = 10


class RedDetector:
    """Finds red areas of at least MIN_SIDE_PX pixels in an input that is INPUT_WIDTH_PX wide, as a network would."""

    def __init__(self, weak_sides_px: Sequence[int] = ()) -> None:
        self.frames: list[Frame] = []
        self._weak_sides_px = tuple(weak_sides_px)

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return tuple(NounMatch(query, (query,)) for query in queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        self.frames.append(frame)
        red = frame.rgb[..., 0] > 128
        scale = INPUT_WIDTH_PX / frame.camera.width_px
        count, _, boxes, _ = cv2.connectedComponentsWithStats(red.astype(np.uint8), connectivity=4)
        found = []
        for left, top, width, height, _ in boxes[1:count].tolist():
            if min(width, height) * scale < MIN_SIDE_PX:
                continue
            mask = np.zeros(red.shape, np.bool_)
            mask[top : top + height, left : left + width] = red[top : top + height, left : left + width]
            is_weak = frame.camera.width_px == WIDTH_PX and min(width, height) in self._weak_sides_px
            box_px = (float(left), float(top), float(left + width), float(top + height))
            found += [Detection(query, 0.2 if is_weak else 0.8, box_px, mask, None, is_weak) for query in queries]
        return found


def frame_with(*squares: tuple[int, int, int]) -> Frame:
    """Return a frame with red squares of (left, top, side) pixels, recorded with twice as many pixels."""
    recorded = np.zeros((2 * HEIGHT_PX, 2 * WIDTH_PX, 3), np.uint8)
    for left, top, side in squares:
        recorded[2 * top : 2 * (top + side), 2 * left : 2 * (left + side), 0] = 255
    camera = Camera(70.0, 70.0, 40.0, 30.0, WIDTH_PX, HEIGHT_PX)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 2.0, np.float32)
    rgb = np.ascontiguousarray(recorded[::2, ::2])
    return Frame(0, 0, rgb, depth_m, camera, np.eye(4), recorded_rgb=recorded)


@pytest.mark.parametrize("size_px", [(60, 80), (61, 83), (7, 5), (1, 1), (480, 641)])
@pytest.mark.parametrize("per_side", [1, 2, 3, 4])
def test_tiles_cover_every_pixel_and_lie_within_the_image(size_px, per_side):
    covered = np.zeros(size_px, np.bool_)
    tiles = list(tiles_of(size_px, Tiling(per_side)))
    assert len(tiles) == per_side**2
    for tile in tiles:
        assert 0 <= tile.left_px < tile.right_px <= size_px[1]
        assert 0 <= tile.top_px < tile.bottom_px <= size_px[0]
        covered[tile.top_px : tile.bottom_px, tile.left_px : tile.right_px] = True
    assert covered.all()


def test_an_object_of_a_tenth_of_a_side_is_whole_in_a_tile_wherever_it_is():
    for left in range(0, 73):
        tiles = tiles_of((HEIGHT_PX, WIDTH_PX), Tiling(2))
        assert any(tile.left_px <= left and left + 8 <= tile.right_px for tile in tiles)


def test_a_cropped_frame_shows_the_same_points_in_space():
    frame = frame_with((20, 10, 8))
    tile = Tile(15, 5, 55, 45)
    part = crop(frame, tile)
    np.testing.assert_array_equal(part.rgb, frame.rgb[5:45, 15:55])
    np.testing.assert_array_equal(part.sharpest_rgb, frame.sharpest_rgb[10:90, 30:110])
    expected = back_project(frame.depth_m, frame.camera)[5:45, 15:55]
    np.testing.assert_allclose(back_project(part.depth_m, part.camera), expected, atol=1e-6)


def test_small_objects_are_found_in_tiles_and_stated_in_the_image():
    frame = frame_with((62, 8, 8))
    assert RedDetector().detect(frame, ["mug"]) == []
    (found,) = TiledDetector(RedDetector(), Tiling(2)).detect(frame, ["mug"])
    assert found.box_px == (62.0, 8.0, 70.0, 16.0)
    np.testing.assert_array_equal(found.mask, frame.rgb[..., 0] > 0)


def test_one_tile_is_the_whole_image_alone():
    detector = RedDetector()
    assert TiledDetector(detector, Tiling(1)).detect(frame_with((62, 8, 8)), ["mug"]) == []
    assert len(detector.frames) == 1


def test_an_object_found_in_several_tiles_and_in_the_image_counts_once():
    frame = frame_with((36, 26, 8), (5, 5, 12))
    found = TiledDetector(RedDetector(), Tiling(2)).detect(frame, ["mug"])
    assert sorted(each.box_px for each in found) == [(5.0, 5.0, 17.0, 17.0), (36.0, 26.0, 44.0, 34.0)]


def test_parts_of_an_object_at_the_border_of_a_tile_do_not_count():
    frame = frame_with((10, 8, 44))
    (found,) = TiledDetector(RedDetector(), Tiling(2)).detect(frame, ["sofa"])
    assert found.box_px == (10.0, 8.0, 54.0, 52.0)


def test_an_object_cut_by_the_border_of_the_image_counts():
    frame = frame_with((72, 20, 8))
    (found,) = TiledDetector(RedDetector(), Tiling(2)).detect(frame, ["mug"])
    assert found.box_px == (72.0, 20.0, 80.0, 28.0)


def test_a_tile_replaces_a_weak_detection_and_keeps_those_of_other_nouns():
    frame = frame_with((5, 5, 12))
    detector = TiledDetector(RedDetector(weak_sides_px=(12,)), Tiling(2))
    found = detector.detect(frame, ["mug", "bottle"])
    assert [(each.phrase, each.is_weak) for each in found] == [("mug", False), ("bottle", False)]


def test_detections_that_share_a_mask_share_it_in_the_image():
    mug, thing = TiledDetector(RedDetector(), Tiling(2)).detect(frame_with((62, 8, 8)), ["mug", "thing"])
    assert mug.mask is thing.mask


def test_a_time_limit_leaves_tiles_to_the_next_detection():
    detector = RedDetector()
    # a detection takes a second, in a tile and in the whole image; after three of them a fourth would exceed 3.5 s
    tiled = TiledDetector(detector, Tiling(2, time_limit_s=3.5), clock=lambda: float(len(detector.frames)))
    in_last_tile = frame_with((62, 40, 8))
    assert tiled.detect(in_last_tile, ["mug"]) == []
    assert len(detector.frames) == 3
    (found,) = tiled.detect(in_last_tile, ["mug"])
    assert found.box_px == (62.0, 40.0, 70.0, 48.0)
    assert len(detector.frames) == 6


def test_without_time_for_a_tile_the_whole_image_is_still_searched():
    detector = RedDetector()
    tiled = TiledDetector(detector, Tiling(2, time_limit_s=0.0), clock=lambda: float(len(detector.frames)))
    assert len(tiled.detect(frame_with((5, 5, 12)), ["mug"])) == 1
    assert len(detector.frames) == 1


CAMERA = Camera(100.0, 100.0, 100.0, 75.0, 200, 150)
WHOLE_IMAGE = (0.0, 0.0, 200.0, 150.0)


def frame_at(depth_m: float) -> Frame:
    return Frame(0, 0, np.zeros((150, 200, 3), np.uint8), np.full((150, 200), depth_m, np.float32), CAMERA, np.eye(4))


@pytest.mark.parametrize("depth_m", [0.4, 1.0, 2.5])
def test_the_extent_is_the_longer_side_at_the_measured_depth(depth_m):
    assert BoxSizeLimits().extent_m((20.0, 30.0, 120.0, 60.0), frame_at(depth_m)) == pytest.approx(depth_m)
    assert BoxSizeLimits().extent_m((20.0, 30.0, 40.0, 110.0), frame_at(depth_m)) == pytest.approx(0.8 * depth_m)


def test_a_near_object_may_fill_the_image_and_a_far_one_may_not():
    limits = BoxSizeLimits()
    assert limits.accepts("tool", 0.5, WHOLE_IMAGE, frame_at(0.4))
    assert not limits.accepts("tool", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("chair", 0.5, WHOLE_IMAGE, frame_at(0.5))
    assert not limits.accepts("chair", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("couch", 0.5, WHOLE_IMAGE, frame_at(1.0))
    assert limits.accepts("table", 0.5, WHOLE_IMAGE, frame_at(1.5))
    assert not limits.accepts("wardrobe", 0.5, WHOLE_IMAGE, frame_at(2.5))


def test_a_thing_is_about_as_long_as_others_of_its_kind():
    for noun, plausible_m, implausible_m in (("mug", 0.15, 0.6), ("book", 0.4, 1.2), ("chair", 1.2, 3.0)):
        boxes = [(0.0, 0.0, 100.0 * length_m, 10.0) for length_m in (plausible_m, implausible_m)]
        assert [BoxSizeLimits().accepts(noun, 0.4, box, frame_at(1.0)) for box in boxes] == [True, False]


def test_a_confident_detection_may_be_larger():
    accepted = [BoxSizeLimits().accepts("basket", score, WHOLE_IMAGE, frame_at(0.6)) for score in (0.3, 0.6, 0.8)]
    assert accepted == [False, False, True]


def test_the_nearer_part_of_a_box_counts():
    frame = frame_at(4.0)
    frame.depth_m[:75] = 0.4
    assert BoxSizeLimits().extent_m(WHOLE_IMAGE, frame) == pytest.approx(0.8)


def test_without_depth_the_share_of_the_image_counts():
    limits, frame = BoxSizeLimits(), frame_at(0.0)
    assert BoxSizeLimits().extent_m(WHOLE_IMAGE, frame) is None
    assert BoxSizeLimits().extent_m((300.0, 10.0, 320.0, 20.0), frame) is None
    assert limits.accepts("mug", 0.9, (0.0, 0.0, 60.0, 60.0), frame)
    assert not limits.accepts("mug", 0.9, (0.0, 0.0, 100.0, 100.0), frame)
    assert limits.accepts("bed", 0.9, (0.0, 0.0, 150.0, 150.0), frame)
