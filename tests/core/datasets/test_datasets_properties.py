"""Properties of reading sequences: repaired poses are rigid, interpolation is spherical, selections are ranges."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.folder import estimate_up
from gausslite.datasets.pose_track import nearest_rigid, pose_from_quaternion, slerp
from gausslite.datasets.source import Source, select_frames
from gausslite.domain.camera import Camera, back_project, project
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory, require_rigid, rotation_angle_deg

seeds = st.integers(0, 2**32 - 1)


class Numbered(Source):
    """A source that has frame numbers only."""

    name = "numbered"
    camera = Camera(1.0, 1.0, 1.0, 1.0, 2, 2)
    up_axis = (0.0, 0.0, 1.0)
    depth_registered = True

    def __init__(self, numbers: list[int]) -> None:
        self._numbers = numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def indices(self) -> Sequence[int]:
        return self._numbers

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        raise DatasetError("numbered: expected no frame to be read")

    def trajectory(self) -> Trajectory:
        raise DatasetError("numbered: expected no pose to be read")


def random_quat(rng: np.random.Generator) -> np.ndarray:
    quat = rng.normal(size=4)
    return quat / np.linalg.norm(quat)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return pose_from_quaternion("pose", np.zeros(3), random_quat(rng))[:3, :3]


@given(seeds)
def test_a_rounded_rotation_becomes_the_nearest_exact_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    exact = np.eye(4)
    exact[:3, :3] = random_rotation(rng)
    rounded = exact.copy()
    rounded[:3, :3] += rng.uniform(-0.005, 0.005, (3, 3))
    repaired = nearest_rigid("pose", rounded)
    require_rigid("pose", repaired)
    assert np.abs(repaired[:3, :3] @ repaired[:3, :3].T - np.eye(3)).max() < 1e-12
    assert rotation_angle_deg(exact, repaired) < 1.0
    np.testing.assert_allclose(nearest_rigid("pose", repaired), repaired, atol=1e-12)


@given(seeds, st.floats(0, 1))
def test_interpolation_is_linear_in_the_angle(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_quat(rng), random_quat(rng)
    whole = np.arccos(min(1.0, abs(float(a @ b))))
    mixed = slerp(a, b, share)
    assert np.linalg.norm(mixed) == pytest.approx(1.0)
    assert np.arccos(min(1.0, abs(float(a @ mixed)))) == pytest.approx(share * whole, abs=1e-6)
    opposite = slerp(a, -b, share)
    assert abs(float(mixed @ opposite)) == pytest.approx(1.0)


@given(st.sets(st.integers(0, 200), min_size=1), st.integers(0, 210), st.integers(1, 210), st.integers(1, 30))
def test_a_selection_is_a_range_of_numbers(numbers: set[int], start: int, length: int, step: int) -> None:
    source = Numbered(sorted(numbers))
    expected = [n for n in sorted(numbers) if n in range(start, start + length, step)]
    spec = f"{start}:{start + length}:{step}"
    if expected:
        assert [source.indices()[i] for i in select_frames(source, spec)] == expected
    else:
        pytest.raises(DatasetError, select_frames, source, spec).match("no frame is in")


@given(seeds, st.integers(1, 40), st.integers(1, 30))
def test_resizing_selects_existing_depths_and_keeps_the_rays(seed: int, width: int, height: int) -> None:
    rng = np.random.default_rng(seed)
    camera = Camera(18.0, 17.0, 8.3, 6.1, 16, 12)
    depth_m = rng.choice([0.0, 1.0, 2.5], (12, 16)).astype(np.float32)
    rgb = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    small = resize_rgbd(RgbdImage(rgb, depth_m, camera), (width, height))
    assert small.depth_m.shape == (height, width) == small.rgb.shape[:2]
    assert set(np.unique(small.depth_m)) <= set(np.unique(depth_m))
    points = back_project(np.ones((12, 16), np.float32), camera).reshape(-1, 3)
    scaled = project(points, small.camera) / (width / 16, height / 12)
    np.testing.assert_allclose(scaled, project(points, camera), atol=1e-4)


@given(seeds)
def test_up_is_found_for_cameras_without_roll_in_any_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R_world_level = random_rotation(rng)
    rotations = []
    for _ in range(24):
        yaw, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(-0.6, 0.1)
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.cross(forward, (0, 0, 1)) / np.cos(pitch)
        rotations.append(R_world_level @ np.stack([right, np.cross(forward, right), forward], axis=1))
    up = np.array(estimate_up(np.array(rotations), (1.0, 0.0, 0.0)))
    assert up @ R_world_level[:, 2] > 0.9999
