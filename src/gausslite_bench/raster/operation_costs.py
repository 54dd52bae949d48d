"""Measure what one iteration of the CPU rasterizer costs, stage by stage, and beside another library if asked."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from gausslite.errors import InvalidInputError
from gausslite.optimize.parameters import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.cpu_kernels import core_clock_ghz
from gausslite.render.rasterizer import Rendering
from gausslite_bench.raster.block_cost import BlockCost
from gausslite_bench.raster.external_rasterizer import ExternalRasterizer
from gausslite_bench.raster.procedural_room import BenchView, held_view, seed_rows
from gausslite_bench.raster.region_costs import RegionCost, region_costs
from gausslite_bench.raster.repeated_step import LOSSES, TURN, Duration, RestingStep, timed

SIZES = ((320, 240), (640, 480))
GAUSSIANS = (20_000, 100_000, 300_000)
OPERATIONS = (*LOSSES, "forward", "backward")
_SETTLE_S = 0.02


@dataclass(frozen=True, slots=True)
class RasterTiming:
    """What each operation took, whole calls as the mapper pays for them.

    stages_ms: of each fused step, least times. blocks: of the step with L1. yardstick is the other library's and
    regions are what shares of the image cost; both are empty when they were not asked for.
    """

    gaussians: int
    width: int
    height: int
    threads: int
    simd: str
    durations: Mapping[str, Duration]
    stages_ms: Mapping[str, Mapping[str, float]]
    blocks: BlockCost
    yardstick: Mapping[str, Duration] = field(default_factory=dict)
    regions: Sequence[RegionCost] = ()

    def summary(self) -> dict[str, object]:
        """One flat record for scripts: the case, and the least time of each operation."""
        minima = {f"{name}_ms_min": self.durations[name].min_ms for name in OPERATIONS}
        return {**self._case(), **minima}

    def details(self) -> dict[str, object]:
        """Everything that was measured, in sections of plain values."""
        return {
            **self._case(),
            "operations": {name: asdict(duration) for name, duration in self.durations.items()},
            "stages_ms_min": {name: dict(stages) for name, stages in self.stages_ms.items()},
            "blocks": asdict(self.blocks),
            "yardstick": {name: asdict(duration) for name, duration in self.yardstick.items()},
            "regions": [{**asdict(cost), "ratio": cost.ratio} for cost in self.regions],
        }

    def _case(self) -> dict[str, object]:
        return {name: getattr(self, name) for name in ("gaussians", "width", "height", "threads", "simd")}


@dataclass(frozen=True, slots=True)
class RasterBench:
    """What to measure: every size with every number of Gaussians and every instruction set (None: the fastest).

    repetitions counts the timed runs of each operation; threads None means one per core allowed. shares_percent: the
    parts of the image on which the masked, exact step is measured as well.
    """

    sizes: Sequence[tuple[int, int]] = SIZES
    gaussians: Sequence[int] = GAUSSIANS
    simd: Sequence[str | None] = (None,)
    threads: int | None = None
    repetitions: int = 60
    yardstick: Path | None = None
    shares_percent: Sequence[float] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.repetitions <= 100_000:
            raise InvalidInputError(f"repetitions: expected 1 to 100000, got {self.repetitions}")

    def run(self) -> Iterator[RasterTiming]:
        """Measure one case after the other. Raises KernelError, InvalidInputError."""
        for width_px, height_px in self.sizes:
            view = held_view(width_px, height_px)
            for count in self.gaussians:
                for simd in self.simd:
                    yield self._measure(CpuRasterizer(self.threads, simd), _table(count), view)

    def _measure(self, rasterizer: CpuRasterizer, table: SplatTable, view: BenchView) -> RasterTiming:
        """Ours and the other's operations take turns, so that a busy minute of the machine strikes both."""
        ours = _Ours(rasterizer, table, view)
        contenders: list[_Ours | ExternalRasterizer] = [ours]
        if self.yardstick is not None:
            contenders.append(ExternalRasterizer(self.yardstick, rasterizer.threads, _table(table.count), view))
        seconds, clock_ghz = _take_turns(contenders, self.repetitions)
        durations = [{name: Duration.of(times) for name, times in each.items()} for each in seconds]
        blocks = BlockCost.of(ours.evaluations, clock_ghz, rasterizer.threads, ours.stages_ms["fused_l1"])
        return RasterTiming(
            gaussians=table.count,
            width=view.camera.width_px,
            height=view.camera.height_px,
            threads=rasterizer.threads,
            simd=rasterizer.simd,
            durations=durations[0],
            stages_ms=ours.stages_ms,
            blocks=blocks,
            yardstick=durations[1] if self.yardstick is not None else {},
            regions=region_costs(rasterizer, table, view, self.shares_percent, self.repetitions),
        )


class _Ours:
    """The operations of our rasterizer on one case; remembers the least time of every stage."""

    def __init__(self, rasterizer: CpuRasterizer, table: SplatTable, view: BenchView) -> None:
        self.stages_ms: dict[str, dict[str, float]] = {}
        self.evaluations = 0
        self._rasterizer = rasterizer
        self._table = table
        self._view = view
        self._train = RestingStep(rasterizer, table, view)
        self._drawn: Rendering = self._draw()
        self._d_rgb = np.full(view.rgb.shape, 1e-5, np.float32)
        self._d_depth_m = np.full(view.depth_m.shape, 1e-5, np.float32)
        self._d_alpha = np.zeros(view.depth_m.shape, np.float32)

    def turn(self) -> AbstractContextManager[None]:
        """Lend the table to the rasterizer for as long as it is measured."""
        return self._train.bind_tables()

    def fused_l1(self) -> None:
        """One whole iteration with L1 on colour and depth."""
        self._step("fused_l1")

    def fused_l1_ssim(self) -> None:
        """One whole iteration with SSIM too."""
        self._step("fused_l1_ssim")

    def forward(self) -> None:
        """Draw."""
        self._drawn = self._draw()

    def backward(self) -> None:
        """From gradients of the image to gradients of the rows; after `forward`."""
        self._rasterizer.backward(self._drawn, self._d_rgb, self._d_depth_m, self._d_alpha)

    def _draw(self) -> Rendering:
        return self._rasterizer.forward(self._table.rows, self._view.camera, self._view.T_camera_world)

    def _step(self, name: str) -> None:
        self._train(LOSSES[name])
        self.evaluations = self._rasterizer.block_evaluations()
        least = self.stages_ms.setdefault(name, {})
        for stage, ms in self._rasterizer.stage_times_ms().items():
            least[stage] = min(ms, least.get(stage, ms))


def _table(count: int) -> SplatTable:
    table = SplatTable(count)
    table.append_rows(
        seed_rows(count), np.zeros(count, np.bool_), np.zeros(count, np.uint32), np.full(count, -1, np.int16)
    )
    return table


def _take_turns(
    contenders: Sequence[_Ours | ExternalRasterizer], repetitions: int
) -> tuple[list[dict[str, list[float]]], float]:
    """Seconds of `repetitions` runs of each operation of each contender, in turns; and the fastest clock in between."""
    seconds: list[dict[str, list[float]]] = [{name: [] for name in OPERATIONS} for _ in contenders]
    clock_ghz = 0.0
    for done in range(0, repetitions, TURN):
        turn = min(TURN, repetitions - done)
        for contender, times in zip(contenders, seconds, strict=True):
            # idle threads of the one before may still be spinning on our cores
            time.sleep(_SETTLE_S)
            with contender.turn():
                for fused in LOSSES:
                    times[fused] += timed([getattr(contender, fused)], turn)[0]
                clock_ghz = max(clock_ghz, core_clock_ghz())
                forward, backward = timed([contender.forward, contender.backward], turn)
            times["forward"] += forward
            times["backward"] += backward
    return seconds, clock_ghz
