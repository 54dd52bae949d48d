"""Values of the domain that are refused by name."""

from collections.abc import Callable

import numpy as np
import pytest

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.lens import Lens
from gausslite.domain.pose import Trajectory, Twist

TURN = Twist(np.zeros(3), np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *(
            (lambda focal_px=focal_px: Camera(40.0, focal_px, 16.0, 12.0, 32, 24), "fy_px: expected a positive number")
            for focal_px in (0.0, -1.0, float("nan"), float("inf"), 1e300)
        ),
        (lambda: CameraMotion(TURN, 0.2), "readout_s"),
        (lambda: CameraMotion(TURN, float("nan")), "readout_s"),
        (lambda: CameraMotion(TURN, 0.0, -0.01), "exposure_s"),
        (lambda: CameraMotion(TURN, 0.0, 0.5), "exposure_s"),
        (lambda: CameraMotion(Twist(np.full(3, np.nan), np.zeros(3)), 0.03), "linear_m_s"),
        (lambda: CameraMotion(Twist(np.zeros(3), np.array([0.0, np.inf, 0.0])), 0.03), "angular_rad_s"),
        *(
            (lambda text=text: Lens.parse(text), "lens")
            for text in ("", "radtan", "radtan:1,2", "fisheye:1,2,3,4,5", "radtan:a,b,c,d", "radtan:nan,0,0,0")
        ),
        (lambda: Trajectory(np.array([1.0, 0.0]), np.stack([np.eye(4)] * 2)), "ascending"),
    ],
)
def test_a_wrong_value_is_named(call: Callable[[], object], message: str) -> None:
    pytest.raises(InvalidInputError, call).match(message)
