"""Choose pixels for seeds: by cells (SIS), by gradient (GFD), and the distance to the next one, s0 of Eq. (1).

The spacing s0 (Sec. III-C.2) is the median distance of a seed to its three nearest neighbours, which is the distance to
the second nearest. With λ seeds per pixel it is 0.73 / sqrt(λ) pixels for a Poisson process (π λ r² = 1.678). For one
seed per grid cell it is 0.89 / sqrt(λ), by measurement. λ is counted over 48x48 pixels around a seed. Only pixels from
which seeds are drawn count, so that seeds in a narrow gap do not appear sparse. A pixel covers depth / focal length
metres of a fronto-parallel surface. On slanted surfaces the true spacing is larger, so seeds start slightly smaller
there.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32) / 255.0
_BLOCK_PX = 16
_MEDIAN_POISSON = float(np.sqrt(1.6783 / np.pi))
_MEDIAN_STRATIFIED = 0.89
_MIN_SQUARED_M = 1e-7


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
    side = int(np.ceil(np.sqrt(count * pool.size / len(pixels))))  # so that about `count` cells touch the pool
    rows, columns = np.divmod(pixels, width)
    cells = (rows * side // height) * side + columns * side // width
    arrival = _arrival_times(pixels, pixel_weights, rng)
    first_in_cell = np.full(side * side, -1, np.int64)
    # NumPy keeps the last assignment to a cell: the pixel of the earliest arrival
    latest_first = np.argsort(-arrival, kind="stable")
    first_in_cell[cells[latest_first]] = pixels[latest_first]
    chosen = first_in_cell[first_in_cell >= 0]
    if len(chosen) > count:
        chosen = rng.choice(chosen, count, replace=False)  # at random: the first ones would be those at the top
    return np.sort(chosen)


def _arrival_times(
    pixels: Int64[ndarray, " n"], pixel_weights: Float32[ndarray, "h w"], rng: np.random.Generator
) -> Float32[ndarray, " n"]:
    """Return exponential arrival times with the rates `pixel_weights`.

    The earliest arrivals are a sample by weight without replacement.
    """
    arrival: Float32[ndarray, " n"] = rng.standard_exponential(len(pixels), np.float32) / pixel_weights.ravel()[pixels]
    return arrival


def neighbour_distance_px(
    pixels: Int64[ndarray, " n"], pool: Bool[ndarray, "h w"], stratified: bool
) -> Float32[ndarray, " n"]:
    """Return the median distance of each seed to its three nearest neighbours in pixels, at least 1.

    pixels: flat indices of seeds drawn from `pool`. stratified: True if they were drawn one per grid cell.
    """
    width = pool.shape[1]
    seeds = np.zeros(pool.shape, np.bool_)
    seeds.ravel()[pixels] = True
    # of the pool alone: a narrow gap is not sparse
    density = _count_around(seeds) / np.maximum(_count_around(pool), 1.0)
    rows, columns = np.divmod(pixels, width)
    local = density[rows // _BLOCK_PX, columns // _BLOCK_PX]
    factor = _MEDIAN_STRATIFIED if stratified else _MEDIAN_POISSON
    distance: Float32[ndarray, " n"] = np.maximum(factor / np.sqrt(local), 1.0).astype(np.float32)
    return distance


def initial_spacing_m(
    distance_px: Float32[ndarray, " n"], depth_m: Float32[ndarray, " n"], camera: Camera
) -> Float32[ndarray, " n"]:
    """Return s0 in metres at each seed's depth; its square is at least 1e-7."""
    squared = np.square(camera.length_m(distance_px, depth_m))
    spacing: Float32[ndarray, " n"] = np.sqrt(np.maximum(squared, np.float32(_MIN_SQUARED_M)))
    return spacing


def _count_around(mask: Bool[ndarray, "h w"]) -> Float32[ndarray, "bh bw"]:
    """Return the number of mask pixels in each 16x16 block and its eight neighbours."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, -height % _BLOCK_PX), (0, -width % _BLOCK_PX)))
    by_rows = padded.reshape(-1, _BLOCK_PX, padded.shape[1]).sum(axis=1, dtype=np.uint16)
    blocks = by_rows.reshape(len(by_rows), -1, _BLOCK_PX).sum(axis=2, dtype=np.uint16).astype(np.float32)
    return np.asarray(cv2.boxFilter(blocks, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT))
