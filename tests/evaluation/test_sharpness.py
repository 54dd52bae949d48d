"""Sharpness metrics against their definitions."""

import cv2
import numpy as np
import pytest

from gausslite.domain.errors import InvalidInputError
from gausslite_evaluation.metrics import gradient_deviation, laplacian_ratio


def photograph(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (40, 48, 3), np.uint8)


def blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px))


def test_an_equal_image_is_as_sharp() -> None:
    image = photograph()
    assert laplacian_ratio(image, image) == pytest.approx(1.0)
    assert gradient_deviation(image, image) == pytest.approx(0.0, abs=1e-6)


def test_the_ratio_falls_and_the_deviation_rises_with_blur() -> None:
    image = photograph()
    ratios = [laplacian_ratio(blurred(image, sigma_px), image) for sigma_px in (0.4, 0.8, 1.6)]
    assert 1.0 > ratios[0] > ratios[1] > ratios[2] > 0.0
    assert gradient_deviation(blurred(image, 1.6), image) > gradient_deviation(blurred(image, 0.4), image) > 0.0


def test_a_shift_of_one_pixel_keeps_the_sharpness_that_psnr_punishes() -> None:
    image = photograph()
    shifted = np.roll(image, 1, axis=1)
    inside = np.zeros(image.shape[:2], np.bool_)
    inside[4:-4, 4:-4] = True
    assert laplacian_ratio(shifted, image, inside) == pytest.approx(1.0, abs=0.05)


def test_halving_the_contrast_halves_the_ratio() -> None:
    image = photograph().astype(np.float32) / 255.0
    assert laplacian_ratio(0.5 * image, image) == pytest.approx(0.5, rel=1e-4)


def test_bytes_and_fractions_score_alike() -> None:
    a, b = photograph(0), photograph(1)
    assert laplacian_ratio(a, b) == pytest.approx(laplacian_ratio(a / 255.0, b / 255.0), rel=1e-5)
    assert gradient_deviation(a, b) == pytest.approx(gradient_deviation(a / 255.0, b / 255.0), rel=1e-4)


def test_only_masked_pixels_count() -> None:
    image = photograph()
    half = np.zeros(image.shape[:2], np.bool_)
    half[:, :24] = True
    changed = image.copy()
    changed[:, 26:] = 128  # two columns away, beyond both kernels
    assert laplacian_ratio(changed, image, half) == pytest.approx(1.0)
    assert gradient_deviation(changed, image, half) == pytest.approx(0.0, abs=1e-6)


def test_a_constant_photograph_has_no_ratio() -> None:
    assert laplacian_ratio(photograph(), np.full((40, 48, 3), 128, np.uint8)) is None


def test_an_empty_mask_is_refused() -> None:
    image = photograph()
    with pytest.raises(InvalidInputError, match="mask: expected at least one pixel inside"):
        laplacian_ratio(image, image, np.zeros(image.shape[:2], np.bool_))
