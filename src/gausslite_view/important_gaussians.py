"""Choose the Gaussians of a map that are shown or kept where not all can be: the most important ones."""

from __future__ import annotations

from collections.abc import Iterable

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


def choose_from_parts(parts: Iterable[Gaussians], limit: int) -> tuple[Gaussians, int]:
    """Return the most important Gaussians of a map that is never in memory as a whole, and the number of all."""
    chosen, total = Gaussians.empty(), 0
    for part in parts:
        chosen, total = Gaussians.concatenate([chosen, part]), total + len(part)
        if len(chosen) > 2 * limit:
            chosen = chosen.take(choose_gaussians(chosen, limit))
    return chosen.take(choose_gaussians(chosen, limit)), total


def _importance(gaussians: Gaussians) -> Float32[ndarray, " n"]:
    ordered = np.sort(gaussians.scales_m, axis=1)
    area: Float32[ndarray, " n"] = gaussians.opacities * ordered[:, 1] * ordered[:, 2]
    return area


def _top(rows: Int64[ndarray, " k"], importance: Float32[ndarray, " n"], count: int) -> Int64[ndarray, " c"]:
    if not 0 < count < len(rows):
        return rows[: max(count, 0)]
    return rows[np.argpartition(importance[rows], -count)[-count:]]
