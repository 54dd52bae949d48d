"""The velocity of a trajectory in the camera's own axes."""

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import Trajectory, Twist


def test_twist_of_a_constant_motion_is_found_at_every_pose() -> None:
    truth = Twist(np.array([0.3, -0.1, 0.2]), np.array([0.4, 0.8, -0.2]))
    poses, step = [np.eye(4)], truth.motion(0.001)
    for _ in range(9):
        poses.append(poses[-1] @ step)
    trajectory = Trajectory(np.arange(10) * 0.001, np.array(poses))
    for i in range(10):
        np.testing.assert_allclose(trajectory.twist(i).angular_rad_s, truth.angular_rad_s, atol=1e-6)
        np.testing.assert_allclose(trajectory.twist(i).linear_m_s, truth.linear_m_s, atol=1e-3)
    np.testing.assert_allclose(trajectory.angular_speeds_rad_s(), np.linalg.norm(truth.angular_rad_s), atol=1e-6)


def swinging_camera(times_s: Float64[ndarray, " n"]) -> Trajectory:
    """A camera that swings about its y axis and along its x axis by sin(5 t), in radians and metres."""
    poses = np.repeat(np.eye(4)[None], len(times_s), axis=0)
    for pose, angle_rad in zip(poses, np.sin(5 * times_s), strict=True):
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, angle_rad, 0.0]))[0]
        pose[0, 3] = angle_rad
    return Trajectory(times_s, poses)


def test_the_peak_velocity_of_a_swinging_camera_is_not_smoothed_away() -> None:
    trajectory = swinging_camera((np.arange(9) - 4) * 0.1)
    twist = trajectory.twist(4)
    np.testing.assert_allclose(twist.angular_rad_s, [0.0, 5.0, 0.0], rtol=0.01)
    np.testing.assert_allclose(twist.linear_m_s, [5.0, 0.0, 0.0], rtol=0.03)
    # a line through the neighbours has 4.8
    np.testing.assert_allclose(swinging_camera(np.array([-0.1, 0.0, 0.1])).twist(1).angular_rad_s[1], 4.79, rtol=0.01)


def test_a_gap_in_the_trajectory_is_not_used_for_a_polynomial() -> None:
    times_s = np.array([-3.0, -0.1, 0.0, 0.1, 0.2])
    np.testing.assert_allclose(swinging_camera(times_s).twist(2).angular_rad_s[1], 4.79, rtol=0.01)


def test_a_single_pose_has_no_velocity() -> None:
    twist = Trajectory(np.zeros(1), np.eye(4)[None]).twist(0)
    assert not twist.angular_rad_s.any()
    assert not twist.linear_m_s.any()
