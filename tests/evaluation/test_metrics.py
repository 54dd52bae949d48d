"""Metrics against their definitions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite_evaluation.metrics import covered_share, depth_l1_m, psnr, ssim, ssim_map


def image(seed: int, height: int = 20, width: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def test_psnr_of_a_constant_error_is_its_logarithm() -> None:
    a = np.full((8, 8, 3), 0.5, np.float32)
    assert psnr(a, a + np.float32(0.1)) == pytest.approx(20.0, abs=1e-4)


def test_metrics_accept_bytes_and_fractions() -> None:
    a, b = (np.random.default_rng(seed).integers(0, 256, (9, 7, 3), np.uint8) for seed in (0, 1))
    assert psnr(a, b) == pytest.approx(psnr(a / 255.0, b / 255.0))
    assert ssim(a, b) == pytest.approx(ssim(a / 255.0, b / 255.0))


@given(seed=st.integers(0, 1000))
def test_metrics_are_symmetric_and_best_for_equal_images(seed: int) -> None:
    a, b = image(seed), image(seed + 1)
    assert psnr(a, b) == pytest.approx(psnr(b, a))
    assert ssim(a, b) == pytest.approx(ssim(b, a))
    assert psnr(a, a) == math.inf
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, b) < 1.0


def test_a_mask_limits_the_metrics_to_its_pixels() -> None:
    a, b = image(0), image(1)
    mask = np.zeros(a.shape[:2], np.bool_)
    mask[3:6, 4:9] = True
    changed = np.where(mask[..., None], b, a)
    assert psnr(a, changed, mask) == pytest.approx(psnr(a, b, mask))
    assert psnr(a, changed, ~mask) == math.inf
    assert ssim(a, b, mask) == pytest.approx(ssim_map(a, b)[mask].mean())


def test_a_full_mask_equals_no_mask() -> None:
    a, b = image(0), image(1)
    everywhere = np.ones(a.shape[:2], np.bool_)
    assert psnr(a, b, everywhere) == pytest.approx(psnr(a, b))
    assert ssim(a, b, everywhere) == pytest.approx(ssim(a, b))


def test_ssim_equals_its_windowed_definition_inside_and_at_the_border() -> None:
    a, b = image(2).astype(np.float64), image(3).astype(np.float64)
    actual = ssim_map(a, b)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    padded_a, padded_b = (np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (a, b))
    for y, x in ((0, 0), (10, 12), (19, 3)):
        p, q = padded_a[y : y + 11, x : x + 11], padded_b[y : y + 11, x : x + 11]
        mean_p, mean_q = (window * p).sum((0, 1)), (window * q).sum((0, 1))
        var_p, var_q = (window * p * p).sum((0, 1)) - mean_p**2, (window * q * q).sum((0, 1)) - mean_q**2
        covariance = (window * p * q).sum((0, 1)) - mean_p * mean_q
        expected = ((2 * mean_p * mean_q + 1e-4) * (2 * covariance + 9e-4)) / (
            (mean_p**2 + mean_q**2 + 1e-4) * (var_p + var_q + 9e-4)
        )
        np.testing.assert_allclose(actual[y, x], expected, rtol=1e-9)


def test_depth_error_counts_pixels_with_depth_in_both_images() -> None:
    rendered = np.array([[1.0, 2.0, 0.0, 4.0]], np.float32)
    measured = np.array([[1.5, 0.0, 3.0, 4.25]], np.float32)
    assert depth_l1_m(rendered, measured) == pytest.approx((0.5 + 0.25) / 2)
    assert depth_l1_m(rendered, measured, np.array([[False, True, True, True]])) == pytest.approx(0.25)
    assert depth_l1_m(rendered, measured, np.array([[False, True, True, False]])) is None


def test_coverage_counts_the_measured_pixels_alone() -> None:
    rendered = np.array([[1.0, 2.0, 0.0, 4.0]], np.float32)
    measured = np.array([[1.5, 0.0, 3.0, 4.25]], np.float32)
    assert covered_share(rendered, measured) == pytest.approx(2 / 3)
    assert covered_share(rendered, measured, np.array([[False, True, True, True]])) == 0.5
    assert covered_share(rendered, measured, np.array([[False, True, False, False]])) is None


def test_images_that_do_not_match_are_refused() -> None:
    with pytest.raises(ShapeError, match="uint8 or floating"):
        psnr(np.zeros((4, 4, 3), np.int32), np.zeros((4, 4, 3), np.int32))
    pytest.raises(InvalidInputError, ssim, image(0), image(1), np.zeros((20, 24), np.bool_)).match("at least one pixel")
