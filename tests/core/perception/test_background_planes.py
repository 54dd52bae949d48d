"""Planes around a plant or seat are removed from its mask; other objects, and what is the plane itself, stay."""

from __future__ import annotations

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.perception.background_planes import without_background_planes

CAMERA = Camera(200.0, 200.0, 80.0, 60.0, 160, 120)
NOISE_M = 0.004


def scene(leaf_gap_m: float, slant: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth of leaves before a slanted wall, the leaves' pixels, and a mask that closes the gaps."""
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    wall_m = 2.0 / (1.0 - slant * (columns + 0.5 - CAMERA.cx_px) / CAMERA.fx_px)
    mask = (np.abs(columns - 80) < 30) & (np.abs(rows - 60) < 30)
    leaves = mask & ((columns // 6) % 2 == 0)
    noise_m = np.random.default_rng(1).normal(0.0, NOISE_M, wall_m.shape)
    depth_m = np.where(leaves, wall_m - leaf_gap_m, wall_m) + noise_m
    return depth_m.astype(np.float32), leaves, mask


@pytest.mark.parametrize("leaf_gap_m", [0.08, 0.3])
def test_the_wall_between_leaves_is_removed(leaf_gap_m):
    depth_m, leaves, mask = scene(leaf_gap_m)
    found = without_background_planes("potted plant", mask, depth_m, CAMERA)
    assert (found & leaves).sum() > 0.97 * leaves.sum()
    assert (found & ~leaves).sum() < 0.03 * mask.sum()


def test_two_walls_of_a_corner_are_removed():
    depth_m, leaves, mask = scene(0.0)
    columns = np.arange(160)[None, :]
    offset_px = columns + 0.5 - CAMERA.cx_px
    # of a plane, the inverse depth is linear in the pixels
    depth_m = np.ones((120, 1)) / (0.5 + np.where(offset_px < 0, -0.0008, 0.0015) * offset_px)
    depth_m = np.where(leaves, depth_m - 0.15, depth_m).astype(np.float32)
    found = without_background_planes("plant", mask, depth_m, CAMERA)
    assert (found & leaves).sum() > 0.9 * leaves.sum()
    assert (found & ~leaves).sum() < 0.1 * mask.sum()


@pytest.mark.parametrize("seat", ["chair", "bar stool"])
def test_the_floor_between_the_legs_of_a_seat_is_removed(seat):
    rows = np.broadcast_to(np.arange(120)[:, None] + 0.5, (120, 160))
    columns = np.broadcast_to(np.arange(160)[None, :], (120, 160))
    # the camera looks down by 45 degrees from 1.5 m above the floor
    below = (rows - CAMERA.cy_px) / CAMERA.fy_px
    floor_m = 1.5 * np.sqrt(2.0) / (1.0 + below)
    mask = (np.abs(columns - 80) < 24) & (np.abs(rows - 60) < 24)
    legs = mask & (np.abs(columns - 80) > 18)
    noise_m = np.random.default_rng(1).normal(0.0, NOISE_M, floor_m.shape)
    depth_m = (np.where(legs, floor_m - 0.15, floor_m) + noise_m).astype(np.float32)
    found = without_background_planes(seat, mask, depth_m, CAMERA)
    assert (found & legs).sum() > 0.97 * legs.sum()
    assert (found & ~legs).sum() < 0.03 * mask.sum()


def test_masks_of_other_objects_are_unchanged():
    depth_m, _, mask = scene(0.1)
    np.testing.assert_array_equal(without_background_planes("picture", mask, depth_m, CAMERA), mask)


def test_a_plant_that_is_the_plane_keeps_its_mask():
    depth_m, _, mask = scene(0.0)
    np.testing.assert_array_equal(without_background_planes("ivy", mask, depth_m, CAMERA), mask)


@pytest.mark.parametrize("pixels", [0, 1, 160 * 120])
def test_masks_without_a_ring_are_unchanged(pixels):
    depth_m, _, _ = scene(0.1)
    mask = (np.arange(160 * 120) < pixels).reshape(120, 160)
    np.testing.assert_array_equal(without_background_planes("plant", mask, depth_m, CAMERA), mask)


def test_pixels_without_depth_stay():
    depth_m, leaves, mask = scene(0.1)
    depth_m[leaves] = 0.0
    found = without_background_planes("plant", mask, depth_m, CAMERA)
    assert found[leaves].all()
