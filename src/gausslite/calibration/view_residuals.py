"""Residuals between a rendering and a frame: comparable pixels, and robust least squares under a Gaussian prior."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.render.rasterizer import Rendering

MIN_PIXELS = 200
"""A fit needs at least this many comparable pixels."""
MAX_RELATIVE_DEPTH_ERROR = 0.05
"""Rendered and measured depth within this fraction belong to the same surface."""
OPAQUE_ALPHA = 0.8
"""Pixels of a higher alpha count as covered by the map."""
MAX_PIXELS = 12_000
_CORRELATED_PX = 64.0
"""Residuals of neighbouring pixels are correlated: one pixel in a cell of 8x8 counts as independent."""
_OUTLIER_STDS, _MIN_RESIDUAL_STD = 2.0, 0.005


def comparable_pixels(rendering: Rendering, frame: Frame) -> Int64[ndarray, " n"]:
    """Return flat indices, on an even grid of at most 12 000 pixels, where both images show the same surface."""
    height, width = rendering.alpha.shape
    stride = _grid_stride(rendering)
    grid = np.zeros((height, width), np.bool_)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    depth_error_m = np.abs(rendering.expected_depth_m(OPAQUE_ALPHA) - frame.depth_m)
    same_surface = depth_error_m < MAX_RELATIVE_DEPTH_ERROR * frame.depth_m
    return np.flatnonzero(grid & (rendering.alpha > OPAQUE_ALPHA) & same_surface)


def independent_share(rendering: Rendering) -> float:
    """Return how many independent residuals one pixel of the grid of `comparable_pixels` stands for, at most 1."""
    return min(1.0, _grid_stride(rendering) ** 2 / _CORRELATED_PX)


def solve_with_prior(
    jacobian: Float64[ndarray, "n p"],
    residual: Float64[ndarray, " n"],
    deviation: Float64[ndarray, " p"],
    prior_std: Float64[ndarray, " p"],
    pixel_weight: float,
) -> Float64[ndarray, " p"]:
    """Return the update x that minimises |jacobian · x - residual|² robustly, with deviation + x ~ N(0, prior_std²).

    deviation: how far the parameters are from the prior's mean before the update. Residuals are weighted by
    Geman-McClure, scaled by their median absolute deviation.
    """
    weight = pixel_weight * robust_weights(residual)
    # a standard deviation of 0 fixes its parameter up to floating-point precision
    precision = 1.0 / np.square(np.maximum(prior_std, 1e-9))
    weighted = jacobian * weight[:, None]
    information = weighted.T @ jacobian + np.diag(precision)
    update: Float64[ndarray, " p"] = np.linalg.solve(information, weighted.T @ residual - precision * deviation)
    return update


def robust_weights(residual: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    """Return the weights of Geman-McClure, scaled by the median absolute deviation, divided by the variance."""
    residual_std = max(1.4826 * float(np.median(np.abs(residual))), _MIN_RESIDUAL_STD)
    scaled = np.abs(residual) / residual_std
    weights: Float64[ndarray, " n"] = np.square(1.0 / (1.0 + np.square(scaled / _OUTLIER_STDS))) / residual_std**2
    return weights


def shrinkage(prior_std: float, fit_std: float) -> float:
    """Return the factor by which a fitted change is reduced, in [0, 1].

    Without it, the fits of successive frames would let the map drift.
    """
    return prior_std**2 / (prior_std**2 + fit_std**2)


def _grid_stride(rendering: Rendering) -> int:
    height, width = rendering.alpha.shape
    return int(np.ceil(np.sqrt(height * width / MAX_PIXELS)))
