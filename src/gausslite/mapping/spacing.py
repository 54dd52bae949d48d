"""Tell how far apart seeds lie, without a search tree a frame: s0 of Sec. III-C.2 from how densely pixels were drawn.

s0 is the median of a seed's distances to its three nearest neighbours, that is, the distance to the second nearest.
Seeds drawn at a density of λ a pixel have it at 0.73 / sqrt(λ) pixels when they are scattered at random (a Poisson
process: π λ r² = 1.678), and at 0.89 / sqrt(λ), measured, when there is one in each cell of a grid. λ is counted over
48x48 pixels round a seed, but only over those a seed could have been drawn from, so that the seeds that fill a narrow
gap do not pass for sparse ones. A pixel is depth / focal metres wide on a surface that faces the camera; on slanted
surfaces the true distance is larger, so seeds start a little smaller there.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

_BLOCK_PX = 16
_MEDIAN_SCATTERED = float(np.sqrt(1.6783 / np.pi))
_MEDIAN_STRATIFIED = 0.89
_MIN_SQUARED_M = 1e-7


def neighbour_distance_px(
    pixels: Int64[ndarray, " n"], pool: Bool[ndarray, "h w"], stratified: bool
) -> Float32[ndarray, " n"]:
    """Median distance from each seed to its three nearest others, in pixels; at least one pixel.

    pixels: flat indices of seeds drawn from `pool`. stratified: they were drawn one a cell.
    """
    width = pool.shape[1]
    seeds = np.zeros(pool.shape, np.bool_)
    seeds.ravel()[pixels] = True
    density = _round_about(seeds) / np.maximum(_round_about(pool), 1.0)
    rows, columns = np.divmod(pixels, width)
    local = density[rows // _BLOCK_PX, columns // _BLOCK_PX]
    factor = _MEDIAN_STRATIFIED if stratified else _MEDIAN_SCATTERED
    distance: Float32[ndarray, " n"] = np.maximum(factor / np.sqrt(local), 1.0).astype(np.float32)
    return distance


def initial_spacing_m(
    distance_px: Float32[ndarray, " n"], depth_m: Float32[ndarray, " n"], focal_px: float
) -> Float32[ndarray, " n"]:
    """s0 in metres at each seed's depth, its square clamped to 1e-7."""
    squared = np.square(distance_px * depth_m / np.float32(focal_px))
    spacing: Float32[ndarray, " n"] = np.sqrt(np.maximum(squared, np.float32(_MIN_SQUARED_M)))
    return spacing


def _round_about(marked: Bool[ndarray, "h w"]) -> Float32[ndarray, "bh bw"]:
    """How many pixels are marked in each block of 16x16 and its neighbours."""
    height, width = marked.shape
    filled = np.pad(marked, ((0, -height % _BLOCK_PX), (0, -width % _BLOCK_PX)))
    by_rows = filled.reshape(-1, _BLOCK_PX, filled.shape[1]).sum(axis=1, dtype=np.uint16)
    blocks = by_rows.reshape(len(by_rows), -1, _BLOCK_PX).sum(axis=2, dtype=np.uint16).astype(np.float32)
    return np.asarray(cv2.boxFilter(blocks, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT))
