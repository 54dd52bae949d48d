"""A region's mask contains exactly the pixels whose surface point is in it, for any camera pose."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import BallRegion, VoxelRegion

CAMERA = Camera(60.0, 55.0, 31.7, 24.4, 64, 48)


def random_frame(rng: np.random.Generator) -> Frame:
    rotation, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    T_world_camera[:3, 3] = rng.uniform(-1, 1, 3)
    depth_m = rng.uniform(0.2, 3.0, (48, 64)).astype(np.float32)
    depth_m[rng.random((48, 64)) < 0.1] = 0.0
    return Frame(0, 0, np.zeros((48, 64, 3), np.uint8), depth_m, CAMERA, T_world_camera)


def surface_m(frame: Frame) -> np.ndarray:
    return transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera))


@pytest.mark.parametrize("seed", range(8))
def test_a_ball_contains_points_within_its_radius(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame, centre = random_frame(rng), rng.uniform(-1.5, 1.5, 3).astype(np.float32)
    near = np.linalg.norm(surface_m(frame) - centre, axis=-1) <= 0.6
    mask = BallRegion(tuple(centre.tolist()), 0.6).mask(frame)
    np.testing.assert_array_equal(mask, near & (frame.depth_m > 0))


@pytest.mark.parametrize("seed", range(8))
def test_voxels_contain_their_points_and_those_of_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame, first = random_frame(rng), rng.integers(-12, 8, 3)
    cells = np.floor(surface_m(frame) / np.float32(0.1)).astype(np.int64)
    near = ((cells >= first - 1) & (cells <= first + np.array([4, 3, 3]))).all(axis=-1)
    block = first + np.argwhere(np.ones((4, 3, 3), np.bool_))
    np.testing.assert_array_equal(VoxelRegion(block, 0.1).mask(frame), near & (frame.depth_m > 0))
