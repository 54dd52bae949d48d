"""Keep the map under its cap: what gives way when new seeds come and the table is full."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.seeding import Seeds
from gausslite.optimize.parameters import SplatTable
from gausslite.render.rasterizer import LOGIT


def insert(table: SplatTable, seeds: Seeds, newborn_opacity: float, rng: np.random.Generator) -> int:
    """Add the seeds, the task's first, and return how many were added; the table never exceeds its capacity.

    For the task's seeds others give way: inactive before active, what an earlier task had made dense before the rest
    of the background, the most transparent first. For the rest only inactive Gaussians more transparent than a newborn
    give way; seeds that still do not fit are left out at random. Seeds take the rows of those that give way, so that a
    full table is not moved about.
    """
    roi = seeds.roi.take(_at_random(len(seeds.roi), table.capacity, rng))
    _settle(table, roi, _giving_way(table, None, len(roi) - table.room))
    giving_way = _giving_way(table, newborn_opacity, len(seeds.rest) - table.room)
    rest = seeds.rest.take(_at_random(len(seeds.rest), table.room + len(giving_way), rng))
    _settle(table, rest, giving_way)
    return len(roi) + len(rest)


def _settle(table: SplatTable, seeds: Gaussians, rows: Int64[ndarray, " m"]) -> None:
    """The first seeds take these rows, the others what is free."""
    table.replace(rows, seeds.take(np.arange(len(rows))))
    table.append(seeds.take(np.arange(len(rows), len(seeds))))


def _giving_way(table: SplatTable, below_opacity: float | None, count: int) -> Int64[ndarray, " k"]:
    """Up to `count` rows: an earlier task's surplus, the other inactive ones, the active ones.

    below_opacity: only inactive ones more transparent than this.
    """
    chosen = np.zeros(0, np.int64)
    if count <= 0:
        return chosen
    logits, worked_on = table.rows[:, LOGIT].copy(), table.kappa > 0
    inactive = ~table.active
    if below_opacity is not None:
        inactive &= logits < math.log(below_opacity) - math.log1p(-below_opacity)
    groups = [inactive & worked_on, inactive & ~worked_on]
    if below_opacity is None:
        groups.append(table.active)
    for group in groups:
        faintest = _faintest_of(logits, np.flatnonzero(group), count - len(chosen))
        chosen = np.concatenate([chosen, faintest])
    return chosen


def _faintest_of(logits: Float32[ndarray, " n"], rows: Int64[ndarray, " m"], count: int) -> Int64[ndarray, " k"]:
    """Up to `count` of these ascending rows, the most transparent; of equal ones the earlier."""
    if count >= len(rows):
        return rows
    if count <= 0:
        return rows[:0]
    among = logits[rows]
    limit = np.partition(among, count - 1)[count - 1]
    below, level = np.flatnonzero(among < limit), np.flatnonzero(among == limit)
    faintest: Int64[ndarray, " k"] = rows[np.concatenate([below, level[: count - len(below)]])]
    return faintest


def _at_random(wanted: int, fits: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    if wanted <= fits:
        return np.arange(wanted)
    return np.sort(rng.choice(wanted, fits, replace=False))
