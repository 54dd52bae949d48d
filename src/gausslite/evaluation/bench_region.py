"""Measure what the active phase costs in exact mode by the share of the image that the region takes (Sec. III-D)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.errors import InvalidInputError
from gausslite.evaluation.bench_scene import BenchView
from gausslite.evaluation.bench_step import LOSSES, TURN, Duration, RestingStep, timed
from gausslite.optimize.parameters import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import TILE_PX

SHARES_PERCENT = (5.0, 10.0, 20.0, 50.0, 100.0)


class Layout(StrEnum):
    """How the region's tiles lie in the image."""

    COMPACT = "compact"
    """One object in the middle."""
    SCATTERED = "scattered"
    """Tiles at random: many small things."""


@dataclass(frozen=True, slots=True)
class RegionCost:
    """A masked step that draws these tiles alone, and the step over the whole image measured in turns with it."""

    share_percent: float
    layout: Layout
    loss: str
    region: Duration
    full: Duration

    @property
    def ratio(self) -> float:
        """How much of a full step it costs, by the minima."""
        return self.region.min_ms / self.full.min_ms


def region_costs(
    rasterizer: CpuRasterizer,
    table: SplatTable,
    view: BenchView,
    shares_percent: Sequence[float],
    repetitions: int,
) -> tuple[RegionCost, ...]:
    """Both kinds of step on each share of the tiles, compact and scattered. Raises InvalidInputError for a share."""
    cases = [(share, layout) for share in shares_percent for layout in Layout]
    steps = [RestingStep(rasterizer, table, view)]
    for share, layout in cases:
        tiles = tiles_of_share(view.depth_m.shape, share, layout)
        steps.append(RestingStep(rasterizer, table, view, _pixels_of(tiles, view), tiles))
    costs = []
    for name, loss in LOSSES.items():
        seconds: list[list[float]] = [[] for _ in steps]
        for done in range(0, repetitions, TURN):
            for step, times in zip(steps, seconds, strict=True):
                with step.holding():
                    times += timed([functools.partial(step, loss)], min(TURN, repetitions - done))[0]
        full, *regions = [Duration.of(times) for times in seconds]
        costs += [RegionCost(*case, name, region, full) for case, region in zip(cases, regions, strict=True)]
    return tuple(costs)


def tiles_of_share(size: tuple[int, ...], share_percent: float, layout: Layout) -> Bool[ndarray, "th tw"]:
    """The tiles nearest to the middle of an image of this (height, width), or as many at random; at least one."""
    if not 0 < share_percent <= 100:
        raise InvalidInputError(f"region share: expected more than 0 and at most 100 percent, got {share_percent}")
    rows, columns = (-(-side // TILE_PX) for side in size)
    if layout is Layout.COMPACT:
        y, x = np.mgrid[:rows, :columns]
        away = np.maximum(np.abs(y - (rows - 1) / 2) / rows, np.abs(x - (columns - 1) / 2) / columns)
        order = np.argsort(away.ravel(), kind="stable")
    else:
        order = np.random.default_rng(0).permutation(rows * columns)
    tiles = np.zeros(rows * columns, np.bool_)
    tiles[order[: max(1, round(rows * columns * share_percent / 100))]] = True
    return tiles.reshape(rows, columns)


def _pixels_of(tiles: Bool[ndarray, "th tw"], view: BenchView) -> Bool[ndarray, "h w"]:
    height, width = view.depth_m.shape
    pixels: Bool[ndarray, "h w"] = tiles.repeat(TILE_PX, 0).repeat(TILE_PX, 1)[:height, :width]
    return pixels
