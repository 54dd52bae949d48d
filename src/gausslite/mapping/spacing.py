"""Estimate the spacing s0 of seeds (Sec. III-C.2) from their density in the image, without a search tree.

s0 is the median distance of a seed to its three nearest neighbours, which is the distance to the second nearest. With
λ seeds per pixel it is 0.73 / sqrt(λ) pixels for a Poisson process (π λ r² = 1.678). For one seed per grid cell it is
0.89 / sqrt(λ), by measurement. λ is counted over 48x48 pixels around a seed. Only pixels from which seeds are drawn
count, so that seeds in a narrow gap do not appear sparse. A pixel covers depth / focal length metres of a
fronto-parallel surface. On slanted surfaces the true spacing is larger, so seeds start slightly smaller there.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera

_BLOCK_PX = 16
_MEDIAN_POISSON = float(np.sqrt(1.6783 / np.pi))
_MEDIAN_STRATIFIED = 0.89
_MIN_SQUARED_M = 1e-7


def neighbour_distance_px(
    pixels: Int64[ndarray, " n"], pool: Bool[ndarray, "h w"], stratified: bool
) -> Float32[ndarray, " n"]:
    """Return the median distance of each seed to its three nearest neighbours in pixels, at least 1.

    pixels: flat indices of seeds drawn from `pool`. stratified: True if they were drawn one per grid cell.
    """
    width = pool.shape[1]
    seeds = np.zeros(pool.shape, np.bool_)
    seeds.ravel()[pixels] = True
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
