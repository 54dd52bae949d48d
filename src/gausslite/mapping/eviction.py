"""Keep the map under its cap: insert seeds, and evict Gaussians of less use if the table is full."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.seeding import Seeds
from gausslite.optimize.splat_table import SplatTable


def insert_seeds(
    table: SplatTable, seeds: Seeds, seed_opacity: float, rng: np.random.Generator, min_background: int = 0
) -> int:
    """Insert the ROI seeds, then the background seeds, and return how many; the table never exceeds its capacity.

    ROI seeds evict background Gaussians first (those active in an earlier task before the others), then active ones,
    each in the order of opacity. At least min_background inactive Gaussians stay, so that an ROI as large as the image
    does not fill the map. Background seeds evict only inactive Gaussians less opaque than seed_opacity. Seeds beyond
    the remaining capacity are dropped at random. Seeds reuse the evicted rows, so that few rows move.
    """
    evicted = _evict_for_roi(table, len(seeds.roi) - table.free_slots, min_background)
    roi = seeds.roi.take(_random_subset(len(seeds.roi), table.free_slots + len(evicted), rng))
    _write(table, roi, evicted)
    evicted = _evict_for_background(table, len(seeds.background) - table.free_slots, seed_opacity)
    capacity = table.free_slots + len(evicted)
    background = seeds.background.take(_random_subset(len(seeds.background), capacity, rng))
    _write(table, background, evicted)
    return len(roi) + len(background)


def _write(table: SplatTable, seeds: Gaussians, evicted: Int64[ndarray, " m"]) -> None:
    """Write the first seeds to the evicted rows and the others to free slots."""
    table.replace(evicted, seeds.take(np.arange(len(evicted))))
    table.append(seeds.take(np.arange(len(evicted), len(seeds))))


def _evict_for_roi(table: SplatTable, count: int, min_background: int) -> Int64[ndarray, " k"]:
    """Return up to `count` rows: inactive ones, except min_background of them, then active ones."""
    if count <= 0:
        return np.zeros(0, np.int64)
    evictable = max(0, int(np.count_nonzero(~table.active)) - min_background)
    background = _least_opaque_inactive(table, min(count, evictable), ~table.active)
    roi = table.most_transparent(np.flatnonzero(table.active), count - len(background))
    return np.concatenate([background, roi])


def _evict_for_background(table: SplatTable, count: int, max_opacity: float) -> Int64[ndarray, " k"]:
    """Return up to `count` rows of inactive Gaussians less opaque than max_opacity."""
    if count <= 0:
        return np.zeros(0, np.int64)
    return _least_opaque_inactive(table, count, ~table.active & table.has_lower_opacity(max_opacity))


def _least_opaque_inactive(table: SplatTable, count: int, candidates: Bool[ndarray, " n"]) -> Int64[ndarray, " k"]:
    """Return up to `count` candidates, the least opaque; those active in an earlier task (kappa > 0) come first."""
    was_active = table.kappa > 0
    earlier_roi = table.most_transparent(np.flatnonzero(candidates & was_active), count)
    others = table.most_transparent(np.flatnonzero(candidates & ~was_active), count - len(earlier_roi))
    return np.concatenate([earlier_roi, others])


def _random_subset(count: int, capacity: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    """Return the indices 0 .. count - 1, or a random subset of `capacity` of them, ascending."""
    if count <= capacity:
        return np.arange(count)
    return np.sort(rng.choice(count, capacity, replace=False))
