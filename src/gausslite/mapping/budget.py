"""Keep the map under its cap: what gives way when new seeds come and the table is full."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64
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
    _settle(table, roi, _giving_way(table, np.ones(table.count, np.bool_), len(roi) - table.room))
    fainter = ~table.active & (table.opacities < newborn_opacity)
    giving_way = _giving_way(table, fainter, len(seeds.rest) - table.room)
    rest = seeds.rest.take(_at_random(len(seeds.rest), table.room + len(giving_way), rng))
    _settle(table, rest, giving_way)
    return len(roi) + len(rest)


def _settle(table: SplatTable, seeds: Gaussians, rows: Int64[ndarray, " m"]) -> None:
    """The first seeds take these rows, the others what is free."""
    table.replace(rows, seeds.take(np.arange(len(rows))))
    table.append(seeds.take(np.arange(len(rows), len(seeds))))


def _giving_way(table: SplatTable, candidates: Bool[ndarray, " n"], count: int) -> Int64[ndarray, " k"]:
    """Up to `count` of the candidates: an earlier task's surplus, the other inactive ones, the active ones."""
    inactive, worked_on = candidates & ~table.active, table.kappa > 0
    chosen = np.zeros(0, np.int64)
    for group in (inactive & worked_on, inactive & ~worked_on, candidates & table.active):
        faintest = _faintest_of(table, np.flatnonzero(group), count - len(chosen))
        chosen = np.concatenate([chosen, faintest])
    return chosen


def _faintest_of(table: SplatTable, rows: Int64[ndarray, " m"], count: int) -> Int64[ndarray, " k"]:
    """Up to `count` of these ascending rows, the most transparent; of equal ones the earlier."""
    if count >= len(rows):
        return rows
    if count <= 0:
        return rows[:0]
    logits = table.rows[rows, LOGIT]
    limit = np.partition(logits, count - 1)[count - 1]
    below, level = np.flatnonzero(logits < limit), np.flatnonzero(logits == limit)
    faintest: Int64[ndarray, " k"] = rows[np.concatenate([below, level[: count - len(below)]])]
    return faintest


def _at_random(wanted: int, fits: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    if wanted <= fits:
        return np.arange(wanted)
    return np.sort(rng.choice(wanted, fits, replace=False))
