"""The two-room home is deterministic; its poses, masks and depths are exact; its trajectories overlap in part."""

from functools import cache

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source, select_frames
from gausslite.domain.camera import back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import require_rigid, transform_points
from gausslite.domain.voxels import VoxelGrid
from gausslite_sim.home_settings import TRAJECTORY_COUNT
from gausslite_sim.trajectory import walked_laps
from gausslite_sim.two_room_layout import TABLE_CENTRE_M, furnish
from gausslite_sim.two_room_trajectories import TRAJECTORIES


def home(trajectory: int = 0, frames: int = 12, size: str = "80x60", noise: str = "1") -> Source:
    return open_source(f"sim:home?seed=0&trajectory={trajectory}&frames={frames}&size={size}&noise={noise}")


def world_points(frame: Frame) -> np.ndarray:
    points = transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera))
    return points[frame.depth_m > 0]


@cache
def voxels_seen(trajectory: int, frames: int) -> set[int]:
    source, grid = home(trajectory, frames), VoxelGrid(0.10)
    keys = [np.unique(grid.keys(world_points(source.frame(i)))) for i in range(len(source))]
    return set(np.concatenate(keys).tolist())


def test_a_frame_does_not_depend_on_the_order_of_requests() -> None:
    first, second = home(), home()
    later = second.frame(7)
    for i in (7, 0):
        a, b = first.frame(i), second.frame(i)
        assert a.rgb.tobytes() == b.rgb.tobytes()
        assert a.depth_m.tobytes() == b.depth_m.tobytes()
        assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
    assert later.rgb.tobytes() == first.frame(7).rgb.tobytes()


@pytest.mark.slow
def test_two_homes_of_one_seed_are_the_same_and_another_seed_differs() -> None:
    a, b, other = furnish(0), furnish(0), furnish(1)
    for one, two in zip(a, b, strict=True):
        assert one.name == two.name
        for part, again in zip(one.parts, two.parts, strict=True):
            np.testing.assert_array_equal(part.mesh.positions_m, again.mesh.positions_m)
    mugs = [next(item for item in items if item.name == "mug") for items in (a, other)]
    assert not np.array_equal(mugs[0].parts[0].mesh.positions_m, mugs[1].parts[0].mesh.positions_m)


def test_the_source_states_its_camera_and_frames() -> None:
    source = home(frames=30)
    assert source.up_axis == (0.0, 0.0, 1.0)
    assert (source.camera.width_px, source.camera.height_px) == (80, 60)
    assert select_frames(source, "3:10:3") == [3, 6, 9]
    frame = source.frame(3, (40, 30))
    assert frame.rgb.shape == (30, 40, 3)
    assert frame.capture_time_ns == 100_000_000


@pytest.mark.parametrize("trajectory", range(TRAJECTORY_COUNT))
def test_poses_are_rigid_level_and_inside_the_rooms(trajectory: int) -> None:
    for T in TRAJECTORIES[trajectory](60):
        require_rigid("pose", T)
        assert abs(T[2, 0]) < 1e-9
        assert 0.3 < T[0, 3] < 7.8
        assert 0.3 < T[1, 3] < 4.2


@pytest.mark.parametrize("trajectory", range(TRAJECTORY_COUNT))
def test_no_camera_is_inside_an_object(trajectory: int) -> None:
    source = home(trajectory, frames=40, size="40x30", noise="0")
    assert min(float(source.frame(i).depth_m.min()) for i in range(len(source))) > 0.35


def test_trajectories_are_smooth() -> None:
    for trajectory in (0, 1):
        poses = TRAJECTORIES[trajectory](120)
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        turns = np.degrees(np.arccos(np.clip((poses[:-1, :3, 2] * poses[1:, :3, 2]).sum(axis=1), -1, 1)))
        assert steps.max() < 0.20
        assert turns.max() < 15.0


def test_agents_overlap_in_part() -> None:
    a, b = voxels_seen(0, 20), voxels_seen(1, 20)
    assert 0.3 < len(a & b) / len(b) < 0.9
    assert len(a & b) / len(a) < 0.95


def test_held_out_views_are_apart_from_both_trajectories_and_see_the_same_objects() -> None:
    training_positions = np.concatenate([TRAJECTORIES[0](120), TRAJECTORIES[1](120)])[:, :3, 3]
    held_out = TRAJECTORIES[2](20)[:, :3, 3]
    distances = np.linalg.norm(held_out[:, None] - training_positions[None], axis=2).min(axis=1)
    assert distances.min() > 0.25
    seen = voxels_seen(0, 20) | voxels_seen(1, 20)
    new = voxels_seen(2, 10)
    assert len(new & seen) / len(new) > 0.8


def test_the_objects_of_the_tasks_are_visible() -> None:
    def share_of_frames(source: Source, names: tuple[str, ...], pixels: int) -> float:
        regions = source.regions()
        frames = [source.frame(i) for i in range(len(source))]
        return float(np.mean([any(regions[n].mask(f).sum() >= pixels for n in names) for f in frames]))

    chairs = ("chair_1", "chair_2", "chair_3", "chair_4")
    assert share_of_frames(home(0, 6, "160x120"), ("mug",), 30) > 0.9
    assert share_of_frames(home(1, 6, "160x120"), chairs, 300) > 0.5
    assert share_of_frames(home(1, 12, "160x120"), ("mug",), 12) > 0.25


def test_masks_agree_with_depth_and_with_each_other() -> None:
    source = home(noise="0")
    boxes = {}
    for item in furnish(0):
        corners = np.concatenate([part.mesh.positions_m for part in item.parts])
        boxes[item.name] = corners.min(axis=0) - 1e-3, corners.max(axis=0) + 1e-3
    frame = source.frame(2)
    points = transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera))
    covered = np.zeros(frame.depth_m.shape, int)
    for name, region in source.regions().items():
        mask = region.mask(frame)
        covered += mask
        low, high = boxes[name]
        assert ((points[mask] >= low) & (points[mask] <= high)).all(), name
    assert covered.max() == 1
    assert {"table", "mug", "vase", "books", "sofa", "cabinet", "box", "plant", "lamp", "door", "tv"} <= boxes.keys()


def test_a_mask_follows_the_frames_own_camera() -> None:
    source = home(size="160x120")
    mug = source.regions()["mug"]
    whole, half = mug.mask(source.frame(0)), mug.mask(source.frame(0, (80, 60)))
    assert half.shape == (60, 80)
    assert 4 * int(half.sum()) == pytest.approx(int(whole.sum()), rel=0.3)
    assert np.array_equal(whole, mug.mask(source.frame(0)))


def test_without_noise_depth_is_exact() -> None:
    source = home(noise="0", size="160x120")
    frame = source.frame(0)
    points = transform_points(frame.T_world_camera.astype(np.float64), back_project(frame.depth_m, frame.camera))
    table = points[source.regions()["table"].mask(frame)]
    inside = (np.abs(table[:, :2] - TABLE_CENTRE_M) < (0.69, 0.44)).all(axis=1)
    top = table[inside & (table[:, 2] > 0.72)]
    assert len(top) > 1000
    assert np.abs(top[:, 2] - 0.74).max() < 2e-5
    assert (frame.depth_m > 0).all()


def test_noise_grows_with_distance_and_leaves_holes() -> None:
    noisy, exact = home(1, 6, "160x120"), home(1, 6, "160x120", "0")
    errors, depths, losses = [], [], []
    for i in range(6):
        a, b = noisy.frame(i), exact.frame(i)
        valid = a.depth_m > 0
        losses.append(1 - valid.mean())
        errors.append((a.depth_m - b.depth_m)[valid])
        depths.append(b.depth_m[valid])
    error, depth = np.concatenate(errors), np.concatenate(depths)
    near, far = (np.median(np.abs(error[(depth > low) & (depth < high)])) for low, high in ((0.8, 1.4), (2.8, 3.6)))
    assert 0.0005 < near < 0.004
    assert far > 3 * near
    assert 0.005 < np.mean(losses) < 0.2
    difference = np.abs(noisy.frame(0).rgb.astype(int) - exact.frame(0).rgb).mean()
    assert 0.5 < difference < 4


def test_textures_hold_fine_detail() -> None:
    image = home(0, 12, "320x240", "0").frame(2).rgb.astype(np.float64).mean(axis=2)
    gradient = np.abs(np.diff(image, axis=1))
    assert (gradient > 4).mean() > 0.3


def test_every_second_lap_is_the_same_path_backwards() -> None:
    once, laps = TRAJECTORIES[1](11), walked_laps(TRAJECTORIES[1], 3)(11)
    np.testing.assert_allclose(laps[[0, 1, 4, 5, 10]], once[[0, 3, 8, 5, 10]], atol=1e-9)
