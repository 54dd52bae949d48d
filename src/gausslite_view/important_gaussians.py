"""Choose the Gaussians of a map that are shown or kept where not all can be: the most important ones."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians

_ACTIVE_SHARE = 0.5


def choose_gaussians(gaussians: Gaussians, limit: int) -> Int64[ndarray, " m"]:
    """Return the ascending indices of at most `limit` Gaussians, the most important ones.

    Up to half of them belong to the task's region (active); importance within each part is opacity times area.
    """
    if len(gaussians) <= limit:
        return np.arange(len(gaussians))
    importance = _importance(gaussians)
    active, background = np.flatnonzero(gaussians.active), np.flatnonzero(~gaussians.active)
    active_count = min(len(active), max(int(limit * _ACTIVE_SHARE), limit - len(background)))
    parts = [_top(active, importance, active_count), _top(background, importance, limit - active_count)]
    return np.sort(np.concatenate(parts))


def _importance(gaussians: Gaussians) -> Float32[ndarray, " n"]:
    ordered = np.sort(gaussians.scales_m, axis=1)
    area: Float32[ndarray, " n"] = gaussians.opacities * ordered[:, 1] * ordered[:, 2]
    return area


def _top(rows: Int64[ndarray, " k"], importance: Float32[ndarray, " n"], count: int) -> Int64[ndarray, " c"]:
    if count >= len(rows):
        return rows
    if count <= 0:
        return rows[:0]
    return rows[np.argpartition(importance[rows], -count)[-count:]]
