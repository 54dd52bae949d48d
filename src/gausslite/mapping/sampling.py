"""Choose pixels: weighted, without repeats, freely or one in each cell of a grid (SIS and GFD, Sec. III-C)."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / 255.0


def edge_magnitude(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """E(u, v) = ‖∇I(u, v)‖: Sobel magnitude of the luminance in [0, 1], per pixel."""
    luminance = rgb @ _LUMINANCE
    # Sobel's kernels sum to 8 times the slope
    dx = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return np.asarray(cv2.magnitude(dx, dy))


def sample_pixels(
    pool: Bool[ndarray, "h w"], count: int, weight: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Int64[ndarray, " n"]:
    """Up to `count` pixels of the pool (flat indices, ascending), drawn by weight without repeats."""
    pixels = np.flatnonzero(pool)
    if len(pixels) <= count:
        return pixels
    arrival = _arrival(pixels, weight, rng)
    return np.sort(pixels[np.argpartition(arrival, count)[:count]]) if count > 0 else pixels[:0]


def sample_stratified(
    pool: Bool[ndarray, "h w"], count: int, weight: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Int64[ndarray, " n"]:
    """Up to `count` pixels of the pool (flat indices, ascending), one in each cell of a square grid of cells.

    Over a full pool the grid has √count x √count cells (Sec. III-C.2); where only part of the image is in the pool
    the cells shrink, so that about `count` of them still meet it. Inside a cell pixels are drawn by weight.
    """
    pixels = np.flatnonzero(pool)
    if len(pixels) <= count:
        return pixels
    if count == 0:
        return pixels[:0]
    height, width = pool.shape
    side = int(np.ceil(np.sqrt(count * pool.size / len(pixels))))
    rows, columns = np.divmod(pixels, width)
    cells = (rows * side // height) * side + columns * side // width
    arrival = _arrival(pixels, weight, rng)
    first_in_cell = np.full(side * side, -1, np.int64)
    # of repeated cells the last assignment stands: the earliest arrival
    late_to_early = np.argsort(-arrival, kind="stable")
    first_in_cell[cells[late_to_early]] = pixels[late_to_early]
    chosen = first_in_cell[first_in_cell >= 0]
    if len(chosen) > count:
        chosen = rng.choice(chosen, count, replace=False)
    return np.sort(chosen)


def _arrival(
    pixels: Int64[ndarray, " n"], weight: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Float32[ndarray, " n"]:
    """Times of independent arrivals with rates `weight`: taking the earliest draws by weight without repeats."""
    arrival: Float32[ndarray, " n"] = rng.standard_exponential(len(pixels), np.float32) / weight.ravel()[pixels]
    return arrival
