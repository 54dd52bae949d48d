"""Image metrics: PSNR, single-scale SSIM and depth error, over all pixels or inside a mask."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError, ShapeError

SSIM_WINDOW_PX = 11
SSIM_SIGMA_PX = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"], mask: Bool[ndarray, "h w"] | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB over the masked pixels' three channels; infinite for equal images.

    Images are uint8, or floating in [0, 1]. Raises ShapeError, and InvalidInputError if the mask is empty.
    """
    first, second = _unit_images(a, b)
    squared = np.square(first - second)
    mean = float(np.mean(squared if mask is None else squared[_checked_mask(mask, first)]))
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def ssim(a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"], mask: Bool[ndarray, "h w"] | None = None) -> float:
    """Return the mean of `ssim_map` over the masked pixels and three channels. Arguments and errors are `psnr`'s."""
    similarity = ssim_map(a, b)
    return float(np.mean(similarity if mask is None else similarity[_checked_mask(mask, similarity)]))


def ssim_map(a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    """Return single-scale SSIM per pixel (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, zero padding."""
    first, second = _unit_images(a, b)
    mean_a, mean_b = _blur(first), _blur(second)
    variance_a = _blur(first * first) - mean_a * mean_a
    variance_b = _blur(second * second) - mean_b * mean_b
    covariance = _blur(first * second) - mean_a * mean_b
    luminance = (2.0 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
    similarity: Float64[ndarray, "h w 3"] = luminance * (2.0 * covariance + _C2) / (variance_a + variance_b + _C2)
    return similarity


def depth_l1_m(
    depth_m: Float32[ndarray, "h w"], measured_m: Float32[ndarray, "h w"], mask: Bool[ndarray, "h w"] | None = None
) -> float | None:
    """Return the mean absolute depth difference in metres where both depths are positive; None without such pixels.

    Holes in `depth_m` are ignored; `covered_share` reports them.
    """
    both = _measured(depth_m, measured_m, mask) & (depth_m > 0)
    if not both.any():
        return None
    return float(np.abs(depth_m[both].astype(np.float64) - measured_m[both]).mean())


def covered_share(
    depth_m: Float32[ndarray, "h w"], measured_m: Float32[ndarray, "h w"], mask: Bool[ndarray, "h w"] | None = None
) -> float | None:
    """Return the share of pixels with a measured depth where `depth_m` is positive; None without measurements."""
    measured = _measured(depth_m, measured_m, mask)
    return float((depth_m[measured] > 0).mean()) if measured.any() else None


def _measured(
    depth_m: Float32[ndarray, "h w"], measured_m: Float32[ndarray, "h w"], mask: Bool[ndarray, "h w"] | None
) -> Bool[ndarray, "h w"]:
    if depth_m.shape != measured_m.shape:
        raise ShapeError(f"depth: expected the measured shape {measured_m.shape}, got {depth_m.shape}")
    measured: Bool[ndarray, "h w"] = measured_m > 0
    if mask is None:
        return measured
    require_array("mask", mask, depth_m.shape, np.bool_)
    measured &= mask
    return measured


def _unit_images(
    a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"]
) -> tuple[Float64[ndarray, "h w 3"], Float64[ndarray, "h w 3"]]:
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise ShapeError(f"images: expected two of the same shape (h, w, 3), got {a.shape} and {b.shape}")
    return _unit_image(a), _unit_image(b)


def _unit_image(image: Shaped[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    if image.dtype == np.uint8:
        return image / 255.0
    if np.issubdtype(image.dtype, np.floating):
        return image.astype(np.float64)
    raise ShapeError(f"image: expected uint8 or floating values, got {image.dtype}")


def _checked_mask(mask: Bool[ndarray, "h w"], image: Float64[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    require_array("mask", mask, image.shape[:2], np.bool_)
    if not mask.any():
        raise InvalidInputError("mask: expected at least one pixel inside, got none")
    return mask


def _blur(image: Float64[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    import cv2

    window = cv2.getGaussianKernel(SSIM_WINDOW_PX, SSIM_SIGMA_PX, cv2.CV_64F)
    blurred: Float64[ndarray, "h w 3"] = cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)
    return blurred
