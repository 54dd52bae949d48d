"""Lens distortion equals OpenCV's, and its text form round-trips."""

import cv2
import numpy as np
import pytest

from gausslite.domain.lens import Lens

SLOPES = np.random.default_rng(0).uniform(-0.7, 0.7, (2, 200))
RAYS = np.stack([*SLOPES, np.ones(SLOPES.shape[1])], axis=1)


@pytest.mark.parametrize(
    "numbers", ["0.26,-0.95,-0.005,0.003", "0.26,-0.95,-0.005,0.003,1.16", "0.1,0.2,0.001,0.002,0.3,0.1,0.05,0.2"]
)
def test_radial_tangential_distortion_equals_opencv(numbers: str) -> None:
    lens = Lens.parse(f"radtan:{numbers}")
    expected, _ = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens.coefficients))
    np.testing.assert_allclose(np.stack(lens.distort(*SLOPES), axis=1), expected[:, 0], atol=1e-12)


def test_fisheye_distortion_equals_opencv_and_is_defined_on_the_axis() -> None:
    lens = Lens.parse("fisheye:0.1,0.02,-0.01,0.001")
    expected, _ = cv2.fisheye.projectPoints(
        RAYS[None], np.zeros(3), np.zeros(3), np.eye(3), np.array(lens.coefficients)
    )
    np.testing.assert_allclose(np.stack(lens.distort(*SLOPES), axis=1), expected[0], atol=1e-12)
    assert [float(value[0]) for value in lens.distort(np.zeros(1), np.zeros(1))] == [0.0, 0.0]


def test_text_form_round_trips() -> None:
    lens = Lens.parse("radtan:0.2624,-0.9531,-0.0054,0.0026,1.1633")
    assert Lens.parse(str(lens)) == lens
