"""Metrics of images and trajectories: PSNR, single-scale SSIM, depth error, sharpness and trajectory error."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.domain.pose import Trajectory
from gausslite.mission.evaluation import TrajectoryError

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


def _checked_mask(mask: Bool[ndarray, "h w"], image: Shaped[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    require_array("mask", mask, image.shape[:2], np.bool_)
    if not mask.any():
        raise InvalidInputError("mask: expected at least one pixel inside, got none")
    return mask


def _blur(image: Float64[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    import cv2

    window = cv2.getGaussianKernel(SSIM_WINDOW_PX, SSIM_SIGMA_PX, cv2.CV_64F)
    return cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)


_RED, _GREEN, _BLUE = (np.float32(weight) for weight in (0.299, 0.587, 0.114))
_GMS_CONSTANT = 170.0 / 255.0**2
"""The constant c of Xue et al. 2014 for colours in [0, 1]."""


def laplacian_ratio(
    rendered: Shaped[ndarray, "h w 3"], photograph: Shaped[ndarray, "h w 3"], mask: Bool[ndarray, "h w"] | None = None
) -> float | None:
    """Return the standard deviation of the rendering's Laplacian, divided by the photograph's, inside the mask.

    1 means equal sharpness, less means blur. Image noise raises the photograph's deviation. None if the photograph is
    constant there. Images are uint8, or floating in [0, 1]. Raises ShapeError, and InvalidInputError for an empty mask.
    """
    deviations = [_laplacian(image)[_inside(mask, image)].std() for image in (rendered, photograph)]
    return float(deviations[0] / deviations[1]) if deviations[1] > 0 else None


def gradient_deviation(
    a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"], mask: Bool[ndarray, "h w"] | None = None
) -> float:
    """Return the gradient magnitude similarity deviation (GMSD; Xue et al. 2014) inside the mask; 0 for equal images.

    Prewitt gradients of the luminance at full resolution, without the reduction to half size of the paper, because the
    images are small. Arguments and errors are those of `laplacian_ratio`.
    """
    first, second = _gradient_magnitude(a), _gradient_magnitude(b)
    similarity = (2.0 * first * second + _GMS_CONSTANT) / (first * first + second * second + _GMS_CONSTANT)
    # in double precision, so that the order of the sum does not show
    return float(similarity[_inside(mask, a)].std(dtype=np.float64))


def _laplacian(image: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    import cv2

    return np.asarray(cv2.Laplacian(_luminance(image), cv2.CV_32F))


def _gradient_magnitude(image: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    import cv2

    prewitt = np.array([[1.0, 0.0, -1.0]] * 3, np.float32) / np.float32(3.0)
    luminance = _luminance(image)
    dx, dy = (cv2.filter2D(luminance, cv2.CV_32F, kernel) for kernel in (prewitt, prewitt.T))
    return np.asarray(np.sqrt(dx * dx + dy * dy))


def _luminance(image: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    scale = np.float32(1.0 / 255.0 if image.dtype == np.uint8 else 1.0)
    red, green, blue = np.moveaxis(np.clip(image.astype(np.float32) * scale, 0.0, 1.0), -1, 0)
    # not a matrix product, whose rounding depends on where the array lies in memory
    luminance: Float32[ndarray, "h w"] = _RED * red + _GREEN * green + _BLUE * blue
    return luminance


def _inside(mask: Bool[ndarray, "h w"] | None, image: Shaped[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    if mask is None:
        return np.ones(image.shape[:2], np.bool_)
    return _checked_mask(mask, image)


_MAX_TIME_GAP_S = 1e-3
_MIN_POSES = 3


def trajectory_error(estimated: Trajectory, reference: Trajectory) -> TrajectoryError | None:
    """Return the ATE of the estimated trajectory; None with fewer than 3 poses at times of the reference (± 1 ms)."""
    if min(len(estimated.times_s), len(reference.times_s)) == 0:
        return None
    after = np.clip(np.searchsorted(reference.times_s, estimated.times_s), 1, max(len(reference.times_s) - 1, 1))
    candidates = np.stack([after - 1, np.minimum(after, len(reference.times_s) - 1)])
    gaps_s = np.abs(reference.times_s[candidates] - estimated.times_s)
    nearest = candidates[np.argmin(gaps_s, axis=0), np.arange(len(estimated.times_s))]
    matched = gaps_s.min(axis=0) <= _MAX_TIME_GAP_S
    if np.count_nonzero(matched) < _MIN_POSES:
        return None
    positions_m = estimated.T_world_camera[matched][:, :3, 3]
    true_m = reference.T_world_camera[nearest[matched]][:, :3, 3]
    errors_m = np.linalg.norm(_aligned(positions_m, true_m) - true_m, axis=1)
    return TrajectoryError(float(np.sqrt(np.mean(np.square(errors_m)))), float(errors_m.max()), len(errors_m))


def _aligned(points: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """Return the points after the rotation and translation that minimise their squared distances (Umeyama 1991)."""
    mean, target_mean = points.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - mean).T @ (target - target_mean))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    aligned: Float64[ndarray, "n 3"] = (points - mean) @ (Vt.T @ mirror @ U.T).T + target_mean
    return aligned
