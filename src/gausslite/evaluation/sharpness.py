"""Sharpness metrics: they show blur that PSNR hides, because PSNR prefers a blurred image to a slightly shifted one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Shaped
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError

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
    require_array("mask", mask, image.shape[:2], np.bool_)
    if not mask.any():
        raise InvalidInputError("mask: expected at least one pixel inside, got none")
    return mask
