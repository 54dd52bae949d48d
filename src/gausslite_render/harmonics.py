"""Evaluate colours that depend on the view, and rotate them: real spherical harmonics of degree 1 to 3.

The order and the signs of the basis are those of 3DGS files (f_rest): degree by degree, m from -l to l, with the
Condon-Shortley phase. Degree 0 is the Gaussian's own colour.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

COUNTS = (0, 3, 8, 15)
"""Number of functions above degree 0, by degree."""
_PI = math.pi
_C1 = math.sqrt(3 / (4 * _PI))
_C2_XY, _C2_ZZ, _C2_XX = (math.sqrt(n / (d * _PI)) for n, d in ((15, 4), (5, 16), (15, 16)))
_C3_3, _C3_2, _C3_1 = (math.sqrt(n / (d * _PI)) for n, d in ((35, 32), (105, 4), (21, 32)))
_C3_0, _C3_XX = math.sqrt(7 / (16 * _PI)), math.sqrt(105 / (16 * _PI))
_DIRECTIONS = 64
"""Sampled to rotate coefficients: more than the 7 functions of degree 3 need."""


def basis(directions: Float[ndarray, "3 n"], count: int) -> list[Float[ndarray, " n"]]:
    """Return the first `count` functions above degree 0 at unit vectors; count: one of COUNTS."""
    x, y, z = directions
    values = [-_C1 * y, _C1 * z, -_C1 * x]
    if count > COUNTS[1]:
        xx, yy, zz = x * x, y * y, z * z
        values += [_C2_XY * x * y, -_C2_XY * y * z, _C2_ZZ * (3 * zz - 1), -_C2_XY * x * z, _C2_XX * (xx - yy)]
    if count > COUNTS[2]:
        values += [
            -_C3_3 * y * (3 * xx - yy),
            _C3_2 * x * y * z,
            -_C3_1 * y * (5 * zz - 1),
            _C3_0 * z * (5 * zz - 3),
            -_C3_1 * x * (5 * zz - 1),
            _C3_XX * z * (xx - yy),
            -_C3_3 * x * (xx - 3 * yy),
        ]
    return values[:count]


def view_colours(
    means_m: Float32[ndarray, "n 3"],
    rgb: Float32[ndarray, "n 3"],
    harmonics: Float32[ndarray, "k 3 n"],
    viewpoint_m: Float64[ndarray, "3"],
) -> Float32[ndarray, "n 3"]:
    """Return the colours seen from a point; rgb: those of degree 0. Negative ones become 0, as in training by 3DGS."""
    directions = np.subtract(means_m.T, viewpoint_m.astype(np.float32)[:, None])
    directions /= np.maximum(np.sqrt(np.square(directions).sum(axis=0)), np.finfo(np.float32).tiny)
    colours = rgb.T.copy()
    product = np.empty_like(colours)
    for values, coefficients in zip(basis(directions, len(harmonics)), harmonics, strict=True):
        np.multiply(coefficients, values, out=product)
        colours += product
    np.maximum(colours, 0, out=colours)
    return colours.T


def rotated(harmonics: Float32[ndarray, "n 3 k"], R: Float64[ndarray, "3 3"]) -> Float32[ndarray, "n 3 k"]:
    """Return the coefficients of a map that is turned by R: each degree is mixed by a matrix of its own.

    The matrix solves basis(Rᵀ d) = M basis(d) at sampled directions d.
    """
    directions = np.random.default_rng(0).normal(size=(3, _DIRECTIONS))
    directions /= np.linalg.norm(directions, axis=0)
    count = harmonics.shape[2]
    before, after = (np.array(basis(at, count)) for at in (R.T @ directions, directions))
    result = np.empty(harmonics.shape, np.float32)
    for first, last in pairwise(COUNTS):
        if last <= count:
            mix = np.linalg.lstsq(after[first:last].T, before[first:last].T, rcond=None)[0]
            result[:, :, first:last] = harmonics[:, :, first:last] @ mix.T.astype(np.float32)
    return result
