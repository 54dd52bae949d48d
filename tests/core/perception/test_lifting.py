"""Masks without what is behind their object, planes that are no solid object, and pixels that locate an object."""

from dataclasses import replace

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import Detection
from gausslite.perception.lifting import (
    FittedPlane,
    filled_outline,
    foreground_mask,
    lift_detections,
    without_background_planes,
)
from gausslite.perception.object_map import Landmark

CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)
PLANE_CAMERA = Camera(200.0, 200.0, 80.0, 60.0, 160, 120)
NOISE_M = 0.004
UP = np.array([0.0, -1.0, 0.0])
WHOLE = np.ones((120, 160), np.bool_)


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
    boxes = [
        Landmark.from_observation(observation).box_m()
        for _, observation in lift_detections(detections, depth_m, frame, UP)
    ]
    return [(box.min_m[0], box.max_m[0]) for box in boxes]


def test_pixels_that_two_nouns_claim_locate_neither_object():
    cabinet, table = (detection("cabinet", 40, 80), detection("table", 70, 130))
    (low_m, high_m), (table_low_m, table_high_m) = widths_m(cabinet, table)
    assert (low_m, high_m) == pytest.approx((-0.8, -0.2), abs=0.06)
    assert (table_low_m, table_high_m) == pytest.approx((0.0, 1.0), abs=0.06)


def test_an_object_inside_the_mask_of_another_is_located_by_all_its_pixels():
    mug, table = detection("mug", 80, 100), detection("table", 40, 120)
    ((mug_low_m, mug_high_m), _) = widths_m(mug, table)
    assert (mug_low_m, mug_high_m) == pytest.approx((0.0, 0.4), abs=0.06)


def test_two_detections_of_one_noun_keep_the_pixels_they_share():
    left, right = detection("cabinet", 40, 80), detection("cabinet", 70, 130)
    ((low_m, high_m), _) = widths_m(left, right)
    assert (low_m, high_m) == pytest.approx((-0.8, 0.0), abs=0.06)


def test_background_between_slats_is_removed():
    depth_m = np.full((120, 160), 1.5, np.float32)
    depth_m[:, ::4] = 3.0
    depth_m[0, 1] = 0.0
    front = foreground_mask(WHOLE, depth_m)
    assert np.array_equal(front, (depth_m == 1.5) | (depth_m == 0.0))


def test_a_few_pixels_in_between_do_not_join_two_layers():
    depth_m, mask = np.full((120, 160), 2.2, np.float32), np.zeros((120, 160), np.bool_)
    mask[40:70, 70:80] = True
    depth_m[40:66, 70:80] = 1.9
    depth_m[66, 70:80] = np.linspace(1.9, 2.2, 10)
    assert np.array_equal(foreground_mask(mask, depth_m), mask & (depth_m < 1.97))


def test_a_receding_table_is_one_layer():
    depth_m = np.broadcast_to(np.linspace(0.8, 4.0, 120, dtype=np.float32)[:, None], (120, 160))
    assert np.array_equal(foreground_mask(WHOLE, depth_m), WHOLE)


def test_a_mask_without_depth_is_unchanged():
    assert np.array_equal(foreground_mask(WHOLE, np.zeros((120, 160), np.float32)), WHOLE)


def scene(leaf_gap_m: float, slant: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth of leaves before a slanted wall, the leaves' pixels, and a mask that closes the gaps."""
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    wall_m = 2.0 / (1.0 - slant * (columns + 0.5 - PLANE_CAMERA.cx_px) / PLANE_CAMERA.fx_px)
    mask = (np.abs(columns - 80) < 30) & (np.abs(rows - 60) < 30)
    leaves = mask & ((columns // 6) % 2 == 0)
    noise_m = np.random.default_rng(1).normal(0.0, NOISE_M, wall_m.shape)
    depth_m = np.where(leaves, wall_m - leaf_gap_m, wall_m) + noise_m
    return depth_m.astype(np.float32), leaves, mask


@pytest.mark.parametrize("leaf_gap_m", [0.08, 0.3])
def test_the_wall_between_leaves_is_removed(leaf_gap_m):
    depth_m, leaves, mask = scene(leaf_gap_m)
    found = without_background_planes(mask, depth_m, PLANE_CAMERA)
    assert (found & leaves).sum() > 0.97 * leaves.sum()
    assert (found & ~leaves).sum() < 0.03 * mask.sum()


def test_two_walls_of_a_corner_are_removed():
    depth_m, leaves, mask = scene(0.0)
    columns = np.arange(160)[None, :]
    offset_px = columns + 0.5 - PLANE_CAMERA.cx_px
    # of a plane, the inverse depth is linear in the pixels
    depth_m = np.ones((120, 1)) / (0.5 + np.where(offset_px < 0, -0.0008, 0.0015) * offset_px)
    depth_m = np.where(leaves, depth_m - 0.15, depth_m).astype(np.float32)
    found = without_background_planes(mask, depth_m, PLANE_CAMERA)
    assert (found & leaves).sum() > 0.9 * leaves.sum()
    assert (found & ~leaves).sum() < 0.1 * mask.sum()


def test_the_floor_between_the_legs_of_a_chair_is_removed():
    rows = np.broadcast_to(np.arange(120)[:, None] + 0.5, (120, 160))
    columns = np.broadcast_to(np.arange(160)[None, :], (120, 160))
    # the camera looks down by 45 degrees from 1.5 m above the floor
    below = (rows - PLANE_CAMERA.cy_px) / PLANE_CAMERA.fy_px
    floor_m = 1.5 * np.sqrt(2.0) / (1.0 + below)
    mask = (np.abs(columns - 80) < 24) & (np.abs(rows - 60) < 24)
    legs = mask & (np.abs(columns - 80) > 18)
    noise_m = np.random.default_rng(1).normal(0.0, NOISE_M, floor_m.shape)
    depth_m = (np.where(legs, floor_m - 0.15, floor_m) + noise_m).astype(np.float32)
    found = without_background_planes(mask, depth_m, PLANE_CAMERA)
    assert (found & legs).sum() > 0.97 * legs.sum()
    assert (found & ~legs).sum() < 0.03 * mask.sum()


def test_an_object_that_is_the_plane_keeps_its_mask():
    depth_m, _, mask = scene(0.0)
    np.testing.assert_array_equal(without_background_planes(mask, depth_m, PLANE_CAMERA), mask)


@pytest.mark.parametrize("pixels", [0, 1, 160 * 120])
def test_masks_without_a_ring_are_unchanged(pixels):
    depth_m, _, _ = scene(0.1)
    mask = (np.arange(160 * 120) < pixels).reshape(120, 160)
    np.testing.assert_array_equal(without_background_planes(mask, depth_m, PLANE_CAMERA), mask)


def test_pixels_without_depth_stay():
    depth_m, leaves, mask = scene(0.1)
    depth_m[leaves] = 0.0
    found = without_background_planes(mask, depth_m, PLANE_CAMERA)
    assert found[leaves].all()


@pytest.mark.parametrize(
    ("size_m", "is_plane"),
    [
        ((1.5, 0.02, 1.0), True),  # a rug
        ((0.5, 0.4, 0.012), True),  # a screen
        ((0.5, 0.9, 0.5), False),  # a chair
        ((2.0, 0.8, 0.9), False),  # a sofa
        ((0.5, 0.4, 0.08), False),  # the back of a chair
        ((0.15, 0.15, 0.004), False),  # too small to be sure
    ],
)
def test_a_rug_and_a_screen_are_planes(size_m, is_plane):
    grid = np.stack(np.meshgrid(*(np.linspace(-side / 2, side / 2, 12) for side in size_m)), axis=-1).reshape(-1, 3)
    assert FittedPlane.of(grid).is_level_or_upright(UP) is is_plane


@pytest.mark.parametrize(("lean_deg", "is_plane"), [(2.0, True), (12.0, False)])
def test_a_thin_back_of_a_chair_leans_and_a_screen_does_not(lean_deg, is_plane):
    along, across = np.meshgrid(np.linspace(0.0, 0.4, 40), np.linspace(0.0, 0.5, 40))
    lean = np.deg2rad(lean_deg)
    points_m = np.column_stack([across.ravel(), -np.cos(lean) * along.ravel(), np.sin(lean) * along.ravel()])
    assert FittedPlane.of(points_m).is_level_or_upright(UP) is is_plane


@pytest.mark.parametrize(("noun", "is_lifted"), [("chair", False), ("potted plant", False), ("monitor", True)])
def test_a_plane_is_no_chair_and_no_plant(noun, is_lifted):
    depth_m = np.full((120, 160), 2.0, np.float32)
    frame = Frame(0, 0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, np.eye(4))
    lifted = lift_detections([detection(noun, 40, 80)], depth_m, frame, UP)
    assert bool(lifted) is is_lifted


def bowl_and_fruit() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A disc at 1.5 m with a smaller disc in it, 2 cm nearer, that touches its upper edge, before a wall at 3 m."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    bowl = np.hypot(columns - 80, rows - 60) < 40
    fruit = np.hypot(columns - 80, rows - 42) < 21
    depth_m = np.where(bowl, 1.5, 3.0)
    depth_m[fruit & bowl] = 1.48
    return bowl & ~fruit, bowl, depth_m.astype(np.float32)


def test_what_a_convex_object_holds_belongs_to_it():
    mask, whole, depth_m = bowl_and_fruit()
    frame = Frame(0, 0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, np.eye(4))
    found = Detection("bowl", 0.9, (40.0, 20.0, 120.0, 100.0), mask)
    ((lifted, _),) = lift_detections([found], depth_m, frame, UP)
    assert lifted.mask[whole].mean() > 0.98
    assert not lifted.mask[~whole].any()
    ((exact, _),) = lift_detections([replace(found, is_exact=True)], depth_m, frame, UP)
    assert np.array_equal(exact.mask, mask)


def test_what_is_behind_or_in_front_of_a_convex_object_is_left_out():
    mask, whole, depth_m = bowl_and_fruit()
    other = whole & ~mask
    for distance_m in (1.0, 2.0, 0.0):
        depth_m[other] = distance_m
        assert np.array_equal(filled_outline(mask, depth_m), mask)
    empty = np.zeros_like(mask)
    assert np.array_equal(filled_outline(empty, depth_m), empty)
