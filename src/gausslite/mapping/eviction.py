"""Keep the map under its cap: what gives way when new seeds come and the table is full."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.seeding import Seeds
from gausslite.optimize.splat_table import SplatTable


def insert_seeds(table: SplatTable, seeds: Seeds, newborn_opacity: float, rng: np.random.Generator, scaffold: int = 0) -> int:
    """Add the seeds, the task's first, and return how many were added; the table never exceeds its capacity.

    For the task's seeds others give way: inactive before active, what an earlier task had made dense before the rest
    of the background, the most transparent first; but `scaffold` of the inactive ones stay, so that a region as large
    as the image does not take it all. For the rest only inactive Gaussians more transparent than a newborn give way;
    seeds that still do not fit are left out at random. Seeds take the rows of those that give way, so that a full table
    is not moved about.
    """
    giving_way = _for_the_region(table, len(seeds.roi) - table.free_slots, scaffold)
    roi = seeds.roi.take(_at_random(len(seeds.roi), table.free_slots + len(giving_way), rng))
    _settle(table, roi, giving_way)
    giving_way = _for_the_rest(table, len(seeds.rest) - table.free_slots, newborn_opacity)
    rest = seeds.rest.take(_at_random(len(seeds.rest), table.free_slots + len(giving_way), rng))
    _settle(table, rest, giving_way)
    return len(roi) + len(rest)


def _settle(table: SplatTable, seeds: Gaussians, rows: Int64[ndarray, " m"]) -> None:
    """The first seeds take these rows, the others what is free."""
    table.replace(rows, seeds.take(np.arange(len(rows))))
    table.append(seeds.take(np.arange(len(rows), len(seeds))))


def _for_the_region(table: SplatTable, count: int, scaffold: int) -> Int64[ndarray, " k"]:
    """Up to `count` rows: an earlier task's surplus, the other inactive ones down to the scaffold, the active ones."""
    if count <= 0:
        return np.zeros(0, np.int64)
    spared = max(0, int(np.count_nonzero(~table.active)) - scaffold)
    background = _inactive(table, min(count, spared), ~table.active)
    region = table.most_transparent(np.flatnonzero(table.active), count - len(background))
    return np.concatenate([background, region])


def _for_the_rest(table: SplatTable, count: int, below_opacity: float) -> Int64[ndarray, " k"]:
    """Up to `count` rows of inactive ones more transparent than this, an earlier task's surplus first."""
    if count <= 0:
        return np.zeros(0, np.int64)
    return _inactive(table, count, ~table.active & table.has_lower_opacity(below_opacity))


def _inactive(table: SplatTable, count: int, candidates: Bool[ndarray, " n"]) -> Int64[ndarray, " k"]:
    """Up to `count` of these rows, those worked on for an earlier task first, the faintest of each."""
    worked_on = table.kappa > 0
    surplus = table.most_transparent(np.flatnonzero(candidates & worked_on), count)
    others = table.most_transparent(np.flatnonzero(candidates & ~worked_on), count - len(surplus))
    return np.concatenate([surplus, others])


def _at_random(wanted: int, fits: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    if wanted <= fits:
        return np.arange(wanted)
    return np.sort(rng.choice(wanted, fits, replace=False))
