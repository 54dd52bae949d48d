"""Cost of the active phase with all Gaussians as a function of the region's share of the image (Sec. III-D)."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import TILE_PX, LossWeights
from gausslite_bench.raster.procedural_room import BenchView
from gausslite_bench.raster.repeated_step import LOSSES, RUNS_PER_BATCH, Duration, RepeatedStep, measure_seconds

SHARES_PERCENT = (5.0, 10.0, 20.0, 50.0, 100.0)


class Layout(StrEnum):
    """Arrangement of the region's tiles in the image."""

    COMPACT = "compact"
    """One block in the centre."""
    SCATTERED = "scattered"
    """Random tiles."""
    BANDS = "bands"
    """Vertical bands that cover the image; their mean is independent of where splats are dense."""


_MAX_BANDS = 20


@dataclass(frozen=True, slots=True)
class RegionCost:
    """Times of a step masked to the region's tiles and of an interleaved step over the whole image.

    work_share: the region's share of the whole image's block evaluations. For several regions, the values are means.
    """

    share_percent: float
    layout: Layout
    loss: str
    region: Duration
    full: Duration
    work_share: float

    @property
    def ratio(self) -> float:
        """Minimum time of the region's step divided by that of the full step."""
        return self.region.min_ms / self.full.min_ms


def region_costs(
    rasterizer: CpuRasterizer,
    table: SplatTable,
    view: BenchView,
    shares_percent: Sequence[float],
    repetitions: int,
) -> tuple[RegionCost, ...]:
    """Return the costs of both losses for each share and layout. Raises InvalidInputError for an invalid share."""
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
        for done in range(0, repetitions, RUNS_PER_BATCH):
            for case in cases:
                case.run(loss, min(RUNS_PER_BATCH, repetitions - done))
        full_step = Duration.of(full.seconds)
        for share, layout, regions in groups:
            mean = Duration.mean([Duration.of(region.seconds) for region in regions])
            work = float(np.mean([region.evaluations for region in regions])) / max(1, full.evaluations)
            costs.append(RegionCost(share, layout, name, mean, full_step, work))
    return tuple(costs)


class _Case:
    """Measured times of a region or of the whole image."""

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
        self._step = RepeatedStep(rasterizer, table, view, None if tiles is None else _pixel_mask(tiles, view), tiles)

    def run(self, loss: LossWeights, repetitions: int) -> None:
        """Append the times of this many steps."""
        with self._step.bind_tables():
            self.seconds += measure_seconds([functools.partial(self._step, loss)], repetitions)[0]
            self.evaluations = self._rasterizer.block_evaluations()


def regions_of_share(size: tuple[int, ...], share_percent: float, layout: Layout) -> tuple[Bool[ndarray, "th tw"], ...]:
    """Return regions with this share of an image's tiles, at least one tile, arranged by the layout.

    size: height and width in pixels. Compact and scattered give one region. Bands cover the image; above twenty, an
    evenly spread selection is returned. Raises InvalidInputError for an invalid share.
    """
    if not 0 < share_percent <= 100:
        raise InvalidInputError(f"region share: expected more than 0 and at most 100 percent, got {share_percent}")
    rows, columns = (-(-side // TILE_PX) for side in size)
    if layout is Layout.BANDS:
        column_major = np.arange(rows * columns).reshape(rows, columns).T.ravel()
        bands = np.array_split(column_major, min(round(100 / share_percent), rows * columns))
        if len(bands) > _MAX_BANDS:
            bands = [bands[i * len(bands) // _MAX_BANDS] for i in range(_MAX_BANDS)]
        return tuple(_tile_mask(band, rows, columns) for band in bands)
    if layout is Layout.COMPACT:
        y, x = np.mgrid[:rows, :columns]
        distance = np.maximum(np.abs(y - (rows - 1) / 2) / rows, np.abs(x - (columns - 1) / 2) / columns)
        order = np.argsort(distance.ravel(), kind="stable")
    else:
        order = np.random.default_rng(0).permutation(rows * columns)
    return (_tile_mask(order[: max(1, round(rows * columns * share_percent / 100))], rows, columns),)


def _tile_mask(indices: Int[ndarray, "n"], rows: int, columns: int) -> Bool[ndarray, "th tw"]:
    tiles = np.zeros(rows * columns, np.bool_)
    tiles[indices] = True
    return tiles.reshape(rows, columns)


def _pixel_mask(tiles: Bool[ndarray, "th tw"], view: BenchView) -> Bool[ndarray, "h w"]:
    height, width = view.depth_m.shape
    return tiles.repeat(TILE_PX, 0).repeat(TILE_PX, 1)[:height, :width]
