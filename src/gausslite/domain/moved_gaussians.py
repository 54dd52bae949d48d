"""Move Gaussians by a rigid transform."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import transform_points


def move_gaussians(gaussians: Gaussians, T: Float64[ndarray, "4 4"]) -> Gaussians:
    """Return the Gaussians moved by a rigid motion."""
    if np.array_equal(T, np.eye(4)) or len(gaussians) == 0:
        return gaussians
    means = transform_points(T, gaussians.means_m.astype(np.float64)).astype(np.float32)
    quats = _multiply(_quaternion(T[:3, :3]), gaussians.quats_wxyz.astype(np.float64)).astype(np.float32)
    return replace(gaussians, means_m=means, quats_wxyz=quats)


def _quaternion(R: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    """Return the unit quaternion (w, x, y, z) of a rotation: the main eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    _, vectors = np.linalg.eigh(K)
    quaternion: Float64[ndarray, "4"] = vectors[:, -1]
    return quaternion


def _multiply(left: Float64[ndarray, "4"], right: Float64[ndarray, "n 4"]) -> Float64[ndarray, "n 4"]:
    """Return the Hamilton products of one quaternion (w, x, y, z) with many."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: Float64[ndarray, "n 4"] = right @ matrix.T
    return product
