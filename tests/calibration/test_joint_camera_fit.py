"""The joint fit of lens, readout time and offset to moving pairs, against a simulated camera's truth."""

import numpy as np
import pytest
from mapping_scenes import wall_frame

from gausslite.datasets.open import open_source
from gausslite.domain.lens import Lens
from gausslite.domain.pose import Trajectory
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.joint_camera_fit import fit_camera
from gausslite_calibration.moving_pairs import MovingPairs

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

SIZE = (160, 120)
HOME = f"sim:home-1?frames=90&size={SIZE[0]}x{SIZE[1]}&noise=0&exposure=0&speed=60"


@pytest.fixture(scope="module")
def moving() -> MovingPairs:
    return MovingPairs.read(open_source(f"{HOME}&shutter=30ms&lens=radtan:-0.2,0.03,0,0"), SIZE)


@pytest.mark.slow
def test_both_radial_coefficients_and_the_readout_time_are_fitted_together(moving: MovingPairs) -> None:
    fit = fit_camera(moving, CameraCorrection(Lens.parse("radtan:-0.15,0,0,0"), readout_s=0.02), fits_lens=True)
    assert fit is not None
    assert fit.correction.lens is not None
    k1, k2 = fit.correction.lens.coefficients[:2]
    assert k1 == pytest.approx(-0.2, abs=0.02)
    assert k2 == pytest.approx(0.03, abs=0.04)
    assert fit.correction.readout_s == pytest.approx(0.03, abs=0.002)
    assert abs(fit.correction.time_offset_s) < 0.002
    assert 0.0 < fit.readout_std_s < 0.002
    assert 0.0 < fit.offset_std_s < 0.002


def test_without_comparable_pairs_there_is_no_fit() -> None:
    still = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    moving = MovingPairs(still, (), {0: wall_frame(0), 1: wall_frame(1)})
    assert fit_camera(moving, CameraCorrection(), fits_lens=False) is None
