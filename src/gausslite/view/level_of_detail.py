"""Order and shape of the splats that a browser draws, so that large maps stay usable in software rendering."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians

DEFAULT_LIMIT = 150_000
_GOLDEN_RATIO = 0.618033988749895
_LEAST_OPACITY = 1e-3


def spread_order(gaussians: Gaussians) -> Int64[ndarray, " n"]:
    """Return all indices so that each prefix is spread evenly over the map, opaque Gaussians first.

    The task's region (active) and the background take turns until one of them is used up.
    """
    # multiples of the golden ratio, modulo 1, are evenly spread over the memory order, which follows space
    priority = ((np.arange(1, len(gaussians) + 1) * _GOLDEN_RATIO) % 1.0) / np.maximum(
        gaussians.opacities.astype(np.float64), _LEAST_OPACITY
    )
    turn = np.empty(len(gaussians), np.int64)
    for part in (np.flatnonzero(gaussians.active), np.flatnonzero(~gaussians.active)):
        turn[part[np.argsort(priority[part], kind="stable")]] = np.arange(len(part))
    order: Int64[ndarray, " n"] = np.argsort(turn, kind="stable")
    return order


def covariances_m2(gaussians: Gaussians) -> Float32[ndarray, "n 3 3"]:
    """Return R diag(scales²) Rᵀ of each Gaussian, in square metres (Sec. III-A)."""
    quats = gaussians.quats_wxyz / np.maximum(np.linalg.norm(gaussians.quats_wxyz, axis=1, keepdims=True), 1e-12)
    w, x, y, z = quats.T
    rotations = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        axis=1,
    ).reshape(-1, 3, 3)
    scaled = rotations * gaussians.scales_m[:, None, :]
    covariances: Float32[ndarray, "n 3 3"] = scaled @ scaled.transpose(0, 2, 1)
    return covariances
