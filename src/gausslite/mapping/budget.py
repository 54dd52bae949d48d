"""Keep the map under its cap: what gives way when new seeds come and the table is full."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.mapping.seeding import Seeds
from gausslite.optimize.parameters import SplatTable


def insert(table: SplatTable, seeds: Seeds, newborn_opacity: float, rng: np.random.Generator) -> int:
    """Add the seeds, the task's first, and return how many were added; the table never exceeds its capacity.

    For the task's seeds others give way: inactive before active, what an earlier task had made dense before the rest
    of the background, the most transparent first. For the rest only inactive Gaussians more transparent than a newborn
    give way; seeds that still do not fit are left out at random.
    """
    roi = _at_random(len(seeds.roi), table.capacity, rng)
    _evict(table, len(roi) - table.room, np.ones(table.count, np.bool_))
    table.append(seeds.roi.take(roi))
    _evict(table, len(seeds.rest) - table.room, ~table.active & (table.opacities < newborn_opacity))
    rest = _at_random(len(seeds.rest), table.room, rng)
    table.append(seeds.rest.take(rest))
    return len(roi) + len(rest)


def _evict(table: SplatTable, count: int, candidates: Bool[ndarray, " n"]) -> None:
    """Drop up to `count` of the candidates: an earlier task's surplus, the other inactive ones, the active ones."""
    if count <= 0:
        return
    rows = np.flatnonzero(candidates)
    retired = ~table.active[rows] & (table.kappa[rows] > 0)
    order = np.lexsort((table.opacities[rows], ~retired, table.active[rows]))
    kept = np.ones(table.count, np.bool_)
    kept[rows[order[:count]]] = False
    table.keep(kept)


def _at_random(wanted: int, fits: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    if wanted <= fits:
        return np.arange(wanted)
    return np.sort(rng.choice(wanted, fits, replace=False))
