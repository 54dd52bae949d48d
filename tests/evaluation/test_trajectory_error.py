"""ATE: independent of a rigid motion, equal to the noise, and None where trajectories share no times."""

import numpy as np
import pytest

from gausslite.domain.pose import Trajectory, transform_of
from gausslite_evaluation.metrics import trajectory_error


def walk(count: int = 50, noise_m: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(0)
    poses = np.array([transform_of(np.append(rng.normal(0, 1, 3), rng.normal(0, 1, 3))) for _ in range(count)])
    poses[:, :3, 3] += np.random.default_rng(1).normal(0, noise_m, (count, 3)) if noise_m else 0
    return Trajectory(np.arange(count) / 10, poses)


def moved(trajectory: Trajectory, twist: list[float]) -> Trajectory:
    return Trajectory(trajectory.times_s, transform_of(np.array(twist, np.float64)) @ trajectory.T_world_camera)


def test_a_rigid_motion_of_the_world_is_no_error() -> None:
    error = trajectory_error(moved(walk(), [1, -2, 3, 0.5, 1.5, -1]), walk())
    assert error is not None
    assert error.rmse_m < 1e-9
    assert error.poses == 50


def test_the_error_is_that_of_the_positions() -> None:
    error = trajectory_error(moved(walk(500, 0.01), [3, 0, 0, 0, 0, 2]), walk(500))
    assert error is not None
    assert error.rmse_m == pytest.approx(0.01 * np.sqrt(3), rel=0.1)
    assert error.rmse_m < error.max_m < 0.1


def test_only_poses_at_common_times_count() -> None:
    every_second = Trajectory(walk().times_s[::2], walk().T_world_camera[::2])
    error = trajectory_error(every_second, walk())
    assert error is not None
    assert error.poses == 25
    assert error.rmse_m < 1e-9
    later = Trajectory(walk().times_s + 100, walk().T_world_camera)
    assert trajectory_error(later, walk()) is None
    assert trajectory_error(walk(2), walk()) is None
