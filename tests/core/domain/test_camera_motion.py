"""Camera motions: limits, and when an image counts as one of a camera at rest."""

import numpy as np

from gausslite.domain.camera import CameraMotion
from gausslite.domain.pose import Twist

_TURN = Twist(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def test_a_camera_is_still_without_velocity_or_times() -> None:
    """A readout time matters only with a velocity, and a velocity only with a readout or exposure time."""
    still = Twist(np.zeros(3), np.zeros(3))
    assert CameraMotion(still, 0.03, 0.01).is_still
    assert CameraMotion(_TURN).is_still
    assert not CameraMotion(_TURN, readout_s=-0.03).is_still
    assert not CameraMotion(_TURN, exposure_s=0.01).is_still


def test_points_of_a_row_move_to_the_camera_at_the_middle_of_the_readout() -> None:
    """The second order in time is exact to a millimetre at hand-held speeds."""
    motion = CameraMotion(Twist(np.array([0.5, -0.3, 0.8]), np.array([-0.6, 1.5, 0.8])), readout_s=0.03)
    points_m = np.array([[0.5, -0.4, 2.0], [-1.0, 0.8, 3.0], [0.1, 0.0, 1.0]])
    row_shares = np.array([0.0, 1.0, 0.5])
    moved = motion.to_middle_row(points_m, row_shares)
    for point, share, result in zip(points_m, row_shares, moved, strict=True):
        T_middle_row = motion.twist.motion(motion.readout_s * (share - 0.5))
        np.testing.assert_allclose(result, T_middle_row[:3, :3] @ point + T_middle_row[:3, 3], atol=1e-4)
    np.testing.assert_array_equal(moved[2], points_m[2])
