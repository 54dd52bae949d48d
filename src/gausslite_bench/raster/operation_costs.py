"""Times of the CPU rasterizer's operations and stages, optionally interleaved with an external rasterizer."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer, core_clock_ghz
from gausslite.render.rasterizer import Rendering
from gausslite_bench.raster.block_cost import BlockCost
from gausslite_bench.raster.external_rasterizer import ExternalRasterizer
from gausslite_bench.raster.motion_costs import MotionCost, motion_costs
from gausslite_bench.raster.procedural_room import BenchView, held_out_view, seed_rows
from gausslite_bench.raster.region_costs import RegionCost, region_costs
from gausslite_bench.raster.repeated_step import LOSSES, RUNS_PER_BATCH, Duration, RepeatedStep, measure_seconds

SIZES = ((320, 240), (640, 480))
GAUSSIANS = (20_000, 100_000, 300_000)
OPERATIONS = (*LOSSES, "forward", "backward")
_PAUSE_S = 0.02


@dataclass(frozen=True, slots=True)
class RasterTiming:
    """Times of one case: whole calls, as the mapper makes them.

    stages_ms: minimum time of each stage of each fused step. blocks: cost of the fused step with L1. external: times
    of the external library, empty without one. motions: costs of steps with a moving camera. regions: costs of steps
    masked to a region, empty without shares.
    """

    gaussians: int
    width: int
    height: int
    threads: int
    simd: str
    durations: Mapping[str, Duration]
    stages_ms: Mapping[str, Mapping[str, float]]
    blocks: BlockCost
    motions: Sequence[MotionCost]
    external: Mapping[str, Duration] = field(default_factory=dict)
    regions: Sequence[RegionCost] = ()

    def summary(self) -> dict[str, object]:
        """Return the case and the minimum time of each operation as one flat JSON object."""
        minima = {f"{name}_ms_min": self.durations[name].min_ms for name in OPERATIONS}
        return {**self._case(), **minima}

    def details(self) -> dict[str, object]:
        """Return all measurements as nested JSON objects."""
        return {
            **self._case(),
            "operations": {name: asdict(duration) for name, duration in self.durations.items()},
            "stages_ms_min": {name: dict(stages) for name, stages in self.stages_ms.items()},
            "blocks": asdict(self.blocks),
            "external": {name: asdict(duration) for name, duration in self.external.items()},
            "motions": [{**asdict(cost), "ratio": cost.ratio} for cost in self.motions],
            "regions": [{**asdict(cost), "ratio": cost.ratio} for cost in self.regions],
        }

    def _case(self) -> dict[str, object]:
        return {name: getattr(self, name) for name in ("gaussians", "width", "height", "threads", "simd")}


@dataclass(frozen=True, slots=True)
class RasterBench:
    """Measures every image size with every number of Gaussians and every instruction set (None: the fastest).

    repetitions: timed runs of each operation. threads: None means one per available core. shares_percent: shares of
    the image for additional measurements of masked steps.
    """

    sizes: Sequence[tuple[int, int]] = SIZES
    gaussians: Sequence[int] = GAUSSIANS
    simd: Sequence[str | None] = (None,)
    threads: int | None = None
    repetitions: int = 60
    external_library: Path | None = None
    shares_percent: Sequence[float] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.repetitions <= 100_000:
            raise InvalidInputError(f"repetitions: expected 1 to 100000, got {self.repetitions}")

    def run(self) -> Iterator[RasterTiming]:
        """Yield the times of each case. Raises KernelError, InvalidInputError."""
        for width_px, height_px in self.sizes:
            view = held_out_view(width_px, height_px)
            for count in self.gaussians:
                for simd in self.simd:
                    yield self._measure(CpuRasterizer(self.threads, simd), _table(count), view)

    def _measure(self, rasterizer: CpuRasterizer, table: SplatTable, view: BenchView) -> RasterTiming:
        own = _OwnOperations(rasterizer, table, view)
        contenders: list[_OwnOperations | ExternalRasterizer] = [own]
        if self.external_library is not None:
            contenders.append(ExternalRasterizer(self.external_library, rasterizer.threads, _table(table.count), view))
        seconds, clock_ghz = _measure_interleaved(contenders, self.repetitions)
        durations = [{name: Duration.of(times) for name, times in second.items()} for second in seconds]
        blocks = BlockCost.of(own.evaluations, clock_ghz, rasterizer.threads, own.stages_ms["fused_l1"])
        return RasterTiming(
            gaussians=table.count,
            width=view.camera.width_px,
            height=view.camera.height_px,
            threads=rasterizer.threads,
            simd=rasterizer.simd,
            durations=durations[0],
            stages_ms=own.stages_ms,
            blocks=blocks,
            motions=motion_costs(rasterizer, table, view, self.repetitions),
            external=durations[1] if self.external_library is not None else {},
            regions=region_costs(rasterizer, table, view, self.shares_percent, self.repetitions),
        )


class _OwnOperations:
    """Operations of GaussLite's CPU rasterizer on one case; stores the minimum time of every stage."""

    def __init__(self, rasterizer: CpuRasterizer, table: SplatTable, view: BenchView) -> None:
        self.stages_ms: dict[str, dict[str, float]] = {}
        self.evaluations = 0
        self._rasterizer = rasterizer
        self._table = table
        self._view = view
        self._train = RepeatedStep(rasterizer, table, view)
        self._rendering: Rendering = self._render()
        self._d_rgb = np.full(view.rgb.shape, 1e-5, np.float32)
        self._d_depth_m = np.full(view.depth_m.shape, 1e-5, np.float32)
        self._d_alpha = np.zeros(view.depth_m.shape, np.float32)

    def active(self) -> AbstractContextManager[None]:
        """Bind the table to the rasterizer during the measurement."""
        return self._train.bind_tables()

    def fused_l1(self) -> None:
        """Run one whole iteration with L1 on colour and depth."""
        self._step("fused_l1")

    def fused_l1_ssim(self) -> None:
        """Run one whole iteration with L1 and SSIM."""
        self._step("fused_l1_ssim")

    def forward(self) -> None:
        """Render the image."""
        self._rendering = self._render()

    def backward(self) -> None:
        """Compute the gradients of the rows from those of the image; call `forward` first."""
        self._rasterizer.backward(self._rendering, self._d_rgb, self._d_depth_m, self._d_alpha)

    def _render(self) -> Rendering:
        return self._rasterizer.forward(self._table.rows, self._view.camera, self._view.T_camera_world)

    def _step(self, name: str) -> None:
        self._train(LOSSES[name])
        self.evaluations = self._rasterizer.block_evaluations()
        minima = self.stages_ms.setdefault(name, {})
        for stage, ms in self._rasterizer.stage_times_ms().items():
            minima[stage] = min(ms, minima.get(stage, ms))


def _table(count: int) -> SplatTable:
    table = SplatTable(count)
    table.append_rows(
        seed_rows(count), np.zeros(count, np.bool_), np.zeros(count, np.uint32), np.full(count, -1, np.int16)
    )
    return table


def _measure_interleaved(
    contenders: Sequence[_OwnOperations | ExternalRasterizer], repetitions: int
) -> tuple[list[dict[str, list[float]]], float]:
    """Return the seconds of each run of each contender's operations, and the highest core clock in GHz.

    The contenders alternate in batches, so that other load on the machine affects all of them.
    """
    seconds: list[dict[str, list[float]]] = [{name: [] for name in OPERATIONS} for _ in contenders]
    clock_ghz = 0.0
    for done in range(0, repetitions, RUNS_PER_BATCH):
        runs = min(RUNS_PER_BATCH, repetitions - done)
        for contender, times in zip(contenders, seconds, strict=True):
            # idle threads of the previous contender may still spin on the cores
            time.sleep(_PAUSE_S)
            with contender.active():
                for fused in LOSSES:
                    times[fused] += measure_seconds([getattr(contender, fused)], runs)[0]
                clock_ghz = max(clock_ghz, core_clock_ghz())
                forward, backward = measure_seconds([contender.forward, contender.backward], runs)
            times["forward"] += forward
            times["backward"] += backward
    return seconds, clock_ghz
