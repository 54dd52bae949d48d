"""Sample pixels by weight without replacement, freely or one per grid cell (SIS and GFD, Sec. III-C.2 and C.3)."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / 255.0


def edge_magnitude(rgb: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    """Return E(u, v) = ‖∇I(u, v)‖, the Sobel gradient magnitude of the luminance in [0, 1] (Sec. III-C.3)."""
    luminance = rgb @ _LUMINANCE
    # the Sobel kernel returns 8 times the derivative
    dx = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    dy = cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return np.asarray(cv2.magnitude(dx, dy))


def sample_pixels(
    pool: Bool[ndarray, "h w"], count: int, pixel_weights: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Int64[ndarray, " n"]:
    """Return up to `count` pixels of the pool (flat indices, ascending), drawn by weight without replacement."""
    pixels = np.flatnonzero(pool)
    if len(pixels) <= count:
        return pixels
    arrival = _arrival_times(pixels, pixel_weights, rng)
    return np.sort(pixels[np.argpartition(arrival, count)[:count]]) if count > 0 else pixels[:0]


def sample_stratified(
    pool: Bool[ndarray, "h w"], count: int, pixel_weights: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Int64[ndarray, " n"]:
    """Return up to `count` pixels of the pool (flat indices, ascending), at most one per cell of a square grid.

    If the pool is the whole image, the grid has √count x √count cells (Sec. III-C.2). For a smaller pool the cells are
    smaller, so that about `count` of them contain pool pixels. Within a cell, the pixel is drawn by weight.
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
    arrival = _arrival_times(pixels, pixel_weights, rng)
    first_in_cell = np.full(side * side, -1, np.int64)
    # NumPy keeps the last assignment to a cell: the pixel of the earliest arrival
    latest_first = np.argsort(-arrival, kind="stable")
    first_in_cell[cells[latest_first]] = pixels[latest_first]
    chosen = first_in_cell[first_in_cell >= 0]
    if len(chosen) > count:
        chosen = rng.choice(chosen, count, replace=False)
    return np.sort(chosen)


def _arrival_times(
    pixels: Int64[ndarray, " n"], pixel_weights: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Float32[ndarray, " n"]:
    """Return exponential arrival times with the rates `pixel_weights`.

    The earliest arrivals are a sample by weight without replacement.
    """
    arrival: Float32[ndarray, " n"] = rng.standard_exponential(len(pixels), np.float32) / pixel_weights.ravel()[pixels]
    return arrival
