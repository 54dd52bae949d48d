"""Surfaces of objects from the votes of masks, and the masks that follow from them along the colour edges."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.perception.surface import (
    VOXEL_SIZES_M,
    SurfaceVotes,
    is_in_large_part,
    mask_votes,
    refined_mask,
    snapped_to_edges,
    surface_mask,
)

CAMERA = Camera(150.0, 150.0, 80.0, 60.0, 160, 120)


def frame_at(x_m: float = 0.0, z_m: float = 0.0, turn_deg: float = 0.0) -> Frame:
    """A box of 0.4 m at 1.6 m before a wall at 2 m, seen by a camera that moves and turns."""
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = x_m, 0.0, z_m
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    T_world_camera[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = np.stack([(columns - 80) / 150, (rows - 60) / 150, np.ones_like(rows)], axis=-1) @ T_world_camera[:3, :3].T
    depth_m = (2.0 - z_m) / rays[..., 2]
    box_m = (1.6 - z_m) / rays[..., 2]
    points = T_world_camera[:3, 3] + box_m[..., None] * rays
    on_box = (np.abs(points[..., 0]) < 0.2) & (np.abs(points[..., 1]) < 0.2)
    depth_m = np.where(on_box, box_m, depth_m).astype(np.float32)
    return Frame(0, 0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA, T_world_camera)


def box_mask(frame: Frame) -> np.ndarray:
    points = back_project(frame.depth_m, CAMERA).reshape(-1, 3).astype(np.float64)
    return (transform_points(frame.T_world_camera, points)[:, 2] < 1.8).reshape(frame.depth_m.shape)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("pose", [(0.3, 0.0, 0.0), (-0.2, -0.5, 0.0), (0.2, 0.0, 10.0)])
def test_a_surface_gives_the_mask_in_other_frames(pose):
    first, other = frame_at(), frame_at(*pose)
    votes = mask_votes(box_mask(first), first)
    assert iou(surface_mask(votes, other), box_mask(other)) > 0.9


def test_an_occluder_and_a_removed_object_leave_no_mask():
    first = frame_at()
    votes = mask_votes(box_mask(first), first)
    hidden = replace(first, depth_m=np.full_like(first.depth_m, 0.5))
    removed = replace(first, depth_m=np.full_like(first.depth_m, 2.0))
    assert not surface_mask(votes, hidden).any()
    assert not surface_mask(votes, removed).any()
    assert not surface_mask(SurfaceVotes.empty(), first).any()
    passed = np.eye(4)
    passed[2, 3] = 3.0
    behind = replace(first, T_world_camera=passed)
    assert not surface_mask(votes, behind).any()


def test_a_mask_that_spills_over_the_wall_is_cut_back_to_the_measured_object():
    frames = [frame_at(x_m) for x_m in (0.0, 0.1, -0.1)]
    votes = SurfaceVotes.empty()
    for frame in frames:
        votes = votes.add(mask_votes(box_mask(frame), frame))
    spilled = frame_at(0.05)
    mask = box_mask(spilled)
    mask[35:90, 30:130] = True
    votes = votes.add(mask_votes(mask, spilled))
    assert iou(mask, box_mask(spilled)) < 0.4
    refined = refined_mask(mask, votes, spilled)
    assert refined[box_mask(spilled)].all()
    assert iou(refined, box_mask(spilled)) > 0.8
    assert iou(surface_mask(votes, frames[0]), box_mask(frames[0])) > 0.9


def test_adjacent_objects_of_one_noun_do_not_vote_each_other_out():
    frame = frame_at()
    box = box_mask(frame)
    columns = np.flatnonzero(box.any(axis=0))
    thirds = [box & np.isin(np.arange(160), part)[None] for part in np.array_split(columns, 3)]
    for siblings, is_whole in ((box, True), (None, False)):
        votes = SurfaceVotes.empty()
        for third in thirds:
            votes = votes.add(mask_votes(third, frame, siblings))
        assert (iou(surface_mask(votes, frame), box) > 0.95) is is_whole


def test_a_detection_of_a_part_is_completed():
    frames = [frame_at(x_m) for x_m in (0.0, 0.1, -0.1)]
    votes = SurfaceVotes.empty()
    for frame in frames:
        votes = votes.add(mask_votes(box_mask(frame), frame))
    part = box_mask(frames[0])
    part[:, 80:] = False
    assert iou(refined_mask(part, votes, frames[0]), box_mask(frames[0])) > 0.8


def test_votes_of_two_halves_are_their_sum():
    frames = [frame_at(x_m) for x_m in (0.0, 0.1, -0.1, 0.2)]
    votes = [mask_votes(box_mask(frame), frame) for frame in frames]
    left, right = votes[0].add(votes[1]), votes[2].add(votes[3])
    one, other = left.add(right), votes[3].add(votes[0]).add(votes[2].add(votes[1]))
    for name in ("keys", "inside", "outside"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_a_part_apart_from_the_object_is_left_out():
    frame = frame_at()
    mask = box_mask(frame)
    mask[50:60, 125:135] = True
    votes = mask_votes(mask, frame)
    assert iou(surface_mask(votes, frame), box_mask(frame)) > 0.9


def test_two_large_parts_are_one_object():
    columns, rows = np.meshgrid(np.linspace(0.0, 0.2, 20), np.linspace(0.0, 0.2, 20))
    part = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3).astype(np.float32)
    points = np.concatenate([part, part + np.float32((0.5, 0, 0)), part[:9] + np.float32((0, 0.5, 0))])
    kept = is_in_large_part(points, np.ones(len(points), np.int64))
    assert kept[:800].all()
    assert not kept[800:].any()
    assert is_in_large_part(points[:0], np.ones(0, np.int64)).shape == (0,)


def test_voxels_follow_the_extent_and_what_a_frame_resolves():
    def disc(diameter_m: float) -> SurfaceVotes:
        grid = np.arange(-diameter_m / 2, diameter_m / 2, diameter_m / 60)
        points = np.stack([*np.meshgrid(grid, grid), np.ones((len(grid), len(grid)))], axis=-1).reshape(-1, 3)
        return SurfaceVotes.from_points(points, np.hypot(points[:, 0], points[:, 1]) < diameter_m / 2)

    mug, table = disc(0.09), disc(0.9)
    assert mug.extent_m == pytest.approx(0.09, rel=0.2)
    assert mug.resolved(0.001).voxel_m == VOXEL_SIZES_M[0]
    assert mug.resolved(0.014).voxel_m == VOXEL_SIZES_M[1]
    assert table.resolved(0.001).voxel_m == VOXEL_SIZES_M[-1]


def test_votes_that_exceed_the_memory_get_larger_voxels():
    side = np.arange(0.0, 2.0, 0.008)
    points = np.stack([*np.meshgrid(side, side), np.ones((len(side), len(side)))], axis=-1).reshape(-1, 3)
    inside = SurfaceVotes.from_points(points, np.ones(len(points), np.bool_))
    assert inside.voxel_m > VOXEL_SIZES_M[0]
    assert len(inside.keys) < len(points) / 2
    assert inside.is_on_surface(points).all()
    near = SurfaceVotes.from_points(points[:10], np.zeros(10, np.bool_))
    both = near.add(inside)
    assert both.voxel_m == inside.voxel_m
    assert np.array_equal(both.outside, inside.add(near).outside)


def red_square() -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy image of a red square on grey, and the square's mask."""
    rng = np.random.default_rng(3)
    square = np.zeros((60, 80), np.bool_)
    square[20:40, 30:55] = True
    rgb = np.where(square[..., None], (200, 40, 30), (120, 125, 118)) + rng.normal(0.0, 2.0, (60, 80, 3))
    return rgb.astype(np.uint8), square


def test_an_outline_moves_to_the_edge():
    rgb, square = red_square()
    for shift in ((0, 1), (1, -1), (-1, 0)):
        rough = np.roll(square, shift, (0, 1))
        snapped = snapped_to_edges(rough, rgb)
        assert (snapped ^ square).sum() < 0.3 * (rough ^ square).sum()


def test_pixels_away_from_the_outline_are_unchanged():
    rgb, square = red_square()
    far = np.zeros_like(square)
    far[5:15, 5:15] = True
    snapped = snapped_to_edges(far, rgb)
    assert snapped[7:13, 7:13].all()
    assert not snapped[18:].any()


def test_masks_at_the_border_and_empty_masks():
    rgb, square = red_square()
    assert not snapped_to_edges(np.zeros_like(square), rgb).any()
    assert snapped_to_edges(np.ones_like(square), rgb).all()


def test_a_plane_around_the_masks_adds_nothing_to_the_extent():
    votes = SurfaceVotes.empty()
    for frame in (frame_at(x_m) for x_m in (0.0, 0.1, -0.1)):
        spilled = cv2.dilate(box_mask(frame).astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
        votes = votes.add(mask_votes(spilled, frame))
    assert np.count_nonzero(votes.surface_m[:, 2] > 1.9) > 0.2 * len(votes.surface_m)
    assert votes.box is not None
    assert np.subtract(votes.box.max_m, votes.box.min_m) == pytest.approx((0.4, 0.4, 0.0), abs=0.06)
