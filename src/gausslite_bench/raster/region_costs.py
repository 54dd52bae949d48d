"""Measure what the active phase costs in exact mode by the share of the image that the region takes (Sec. III-D)."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from gausslite.errors import InvalidInputError
from gausslite.optimize.parameters import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import TILE_PX, LossWeights
from gausslite_bench.raster.procedural_room import BenchView
from gausslite_bench.raster.repeated_step import LOSSES, TURN, Duration, RestingStep, timed

SHARES_PERCENT = (5.0, 10.0, 20.0, 50.0, 100.0)


class Layout(StrEnum):
    """How the region's tiles lie in the image."""

    COMPACT = "compact"
    """One object in the middle."""
    SCATTERED = "scattered"
    """Tiles at random: many small things."""
    BANDS = "bands"
    """The image cut into upright bands, one after the other: their mean, wherever the splats are densest."""


_MOST_BANDS = 20


@dataclass(frozen=True, slots=True)
class RegionCost:
    """A masked step that draws these tiles alone, and the step over the whole image measured in turns with it.

    work_share: of the whole image's block evaluations, how many are in the region. Of several regions, the means.
    """

    share_percent: float
    layout: Layout
    loss: str
    region: Duration
    full: Duration
    work_share: float

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
    """Both kinds of step on each share of the tiles, in every layout. Raises InvalidInputError for a share."""
    full = _Case(rasterizer, table, view)
    groups = [
        (share, layout, [_Case(rasterizer, table, view, tiles) for tiles in regions])
        for share in shares_percent
        for layout in Layout
        for regions in [regions_of_share(view.depth_m.shape, share, layout)]
    ]
    cases = [full, *itertools.chain.from_iterable(regions for _, _, regions in groups)]
    costs = []
    for name, loss in LOSSES.items():
        for case in cases:
            case.seconds.clear()
        for done in range(0, repetitions, TURN):
            for case in cases:
                case.turn(loss, min(TURN, repetitions - done))
        whole = Duration.of(full.seconds)
        for share, layout, regions in groups:
            mean = Duration.mean([Duration.of(region.seconds) for region in regions])
            work = float(np.mean([region.evaluations for region in regions])) / max(1, full.evaluations)
            costs.append(RegionCost(share, layout, name, mean, whole, work))
    return tuple(costs)


class _Case:
    """A region, or the whole image, and what was measured of it."""

    def __init__(
        self,
        rasterizer: CpuRasterizer,
        table: SplatTable,
        view: BenchView,
        tiles: Bool[ndarray, "th tw"] | None = None,
    ) -> None:
        self.seconds: list[float] = []
        self.evaluations = 0
        self._rasterizer = rasterizer
        self._step = RestingStep(rasterizer, table, view, None if tiles is None else _pixels_of(tiles, view), tiles)

    def turn(self, loss: LossWeights, repetitions: int) -> None:
        """Time some steps."""
        with self._step.bind_tables():
            self.seconds += timed([functools.partial(self._step, loss)], repetitions)[0]
            self.evaluations = self._rasterizer.block_evaluations()


def regions_of_share(size: tuple[int, ...], share_percent: float, layout: Layout) -> tuple[Bool[ndarray, "th tw"], ...]:
    """Regions of so many of an image's tiles, at least one, where the layout says.

    size: height and width in pixels. Compact and scattered are one region; bands are as many as it takes to cover the
    image, or twenty of them, evenly spread. Raises InvalidInputError for a share that is none.
    """
    if not 0 < share_percent <= 100:
        raise InvalidInputError(f"region share: expected more than 0 and at most 100 percent, got {share_percent}")
    rows, columns = (-(-side // TILE_PX) for side in size)
    if layout is Layout.BANDS:
        down_the_columns = np.arange(rows * columns).reshape(rows, columns).T.ravel()
        bands = np.array_split(down_the_columns, min(round(100 / share_percent), rows * columns))
        chosen = (
            [bands[i * len(bands) // _MOST_BANDS] for i in range(_MOST_BANDS)] if len(bands) > _MOST_BANDS else bands
        )
        return tuple(_flags(band, rows, columns) for band in chosen)
    if layout is Layout.COMPACT:
        y, x = np.mgrid[:rows, :columns]
        away = np.maximum(np.abs(y - (rows - 1) / 2) / rows, np.abs(x - (columns - 1) / 2) / columns)
        order = np.argsort(away.ravel(), kind="stable")
    else:
        order = np.random.default_rng(0).permutation(rows * columns)
    return (_flags(order[: max(1, round(rows * columns * share_percent / 100))], rows, columns),)


def _flags(numbers: Int[ndarray, "n"], rows: int, columns: int) -> Bool[ndarray, "th tw"]:
    tiles = np.zeros(rows * columns, np.bool_)
    tiles[numbers] = True
    return tiles.reshape(rows, columns)


def _pixels_of(tiles: Bool[ndarray, "th tw"], view: BenchView) -> Bool[ndarray, "h w"]:
    height, width = view.depth_m.shape
    pixels: Bool[ndarray, "h w"] = tiles.repeat(TILE_PX, 0).repeat(TILE_PX, 1)[:height, :width]
    return pixels
