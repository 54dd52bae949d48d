"""Speed of the CUDA backend: iterations per second compared with a gsplat training loop, and one mapped frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.keyframes import tiles_touching
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import DensitySettings, MapperSettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.render.rasterizer import FULL_FRAME, Subset, rows_to_gaussians
from gausslite_bench.raster.procedural_room import BenchView, held_out_view, seed_rows
from gausslite_bench.raster.repeated_step import LOSSES, RUNS_PER_BATCH, ZERO_LEARNING_RATES, Duration

if TYPE_CHECKING:
    from gausslite_bench.raster.gsplat_baseline import Rasterization
    from gausslite_gpu.loss import CudaView
    from gausslite_gpu.rasterizer import CudaRasterizer

GPU_GAUSSIANS = (100_000, 300_000, 1_000_000, 3_000_000)
FRAME_GAUSSIANS = 1_000_000
PAPER_FRAME_MS = 500.0
_LOSS = LOSSES["fused_l1_ssim"]
_REGION_SHARE = 0.2
_MARGIN_PX = 5
_CAPACITY_FACTOR = 1.1
_FRAME_WARM_UP = 2


@dataclass(frozen=True, slots=True)
class StepRate:
    """Iterations per second at one number of Gaussians, best and median of the batches.

    Keys of best and median: "whole" (full image), "region" (a fifth of the image), "gsplat" (plain gsplat training on
    the full image).
    """

    gaussians: int
    width: int
    height: int
    best: Mapping[str, float]
    median: Mapping[str, float]

    def as_json(self) -> dict[str, object]:
        """Return one JSON object."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class GpuFrameCost:
    """Time of one mapped frame: seeding, training iterations, density control and all transfers."""

    gaussians: int
    iterations: int
    whole: Duration
    stages_ms: Mapping[str, float]

    def as_json(self) -> dict[str, object]:
        """Return one JSON object."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class GpuBench:
    """Settings and measurements of the benchmark. Tests without a GPU replace gsplat's `rasterization`."""

    rasterizer: CudaRasterizer
    gaussians: Sequence[int] = GPU_GAUSSIANS
    frame_gaussians: int = FRAME_GAUSSIANS
    size: tuple[int, int] = (640, 480)
    repetitions: int = 100
    frames: int = 20
    rasterization: Rasterization | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.repetitions <= 100_000:
            raise InvalidInputError(f"repetitions: expected 1 to 100000, got {self.repetitions}")

    def rates(self) -> Iterator[StepRate]:
        """Yield the iterations per second for each number of Gaussians. Raises KernelError."""
        view = held_out_view(*self.size)
        for count in self.gaussians:
            with ExitStack() as bindings:
                own = _OwnSteps(self.rasterizer, _table(count), view, bindings)
                baseline = self._gsplat_baseline(count, view, own)
                contenders = {"whole": own.whole, "region": own.region, "gsplat": baseline}
                seconds = _measure_interleaved(contenders, self.repetitions)
            yield StepRate(
                count,
                *self.size,
                best={name: 1.0 / min(times) for name, times in seconds.items()},
                median={name: 1.0 / float(np.median(times)) for name, times in seconds.items()},
            )

    def frame(self) -> GpuFrameCost:
        """Map the same view repeatedly, with density control in every frame. Raises KernelError."""
        view = held_out_view(*self.size)
        settings = MapperSettings(
            max_gaussians=int(self.frame_gaussians * _CAPACITY_FACTOR),
            density=DensitySettings(densify_every=MapperSettings().optimization.iterations, prune_every=8),
        )
        mapper = GaussianMapper(settings, self.rasterizer, initial_map=_table(self.frame_gaussians).to_gaussians())
        scheduler, pixel_weights = FrameScheduler(), _region(self.size).astype(np.float32)
        relevance = RelevanceMap(pixel_weights, np.where(pixel_weights > 0, 0, -1).astype(np.int16))
        timings, iterations = [], 0
        for index in range(_FRAME_WARM_UP + self.frames):
            frame = Frame(index, index, view.rgb, view.depth_m, view.camera, inverse(view.T_camera_world))
            scheduler.begin()
            iterations = mapper.map_frame(frame, relevance, scheduler).iterations
            timings.append(scheduler.end())
        measured = timings[_FRAME_WARM_UP:]
        stages = sorted({stage for timing in measured for stage in timing.stages_s})
        return GpuFrameCost(
            mapper.count,
            iterations,
            Duration.of([timing.seconds for timing in measured]),
            {str(s): 1e3 * float(np.median([timing.stages_s.get(s, 0.0) for timing in measured])) for s in stages},
        )

    def _gsplat_baseline(self, count: int, view: BenchView, own: _OwnSteps) -> Callable[[int], float]:
        from gausslite_bench.raster.gsplat_baseline import GsplatBaseline, load_gsplat_rasterization

        rasterization = self.rasterization or load_gsplat_rasterization()
        return GsplatBaseline(seed_rows(count), own.view, view.T_camera_world, _LOSS, rasterization).train


class _OwnSteps:
    """Training steps of the CUDA backend; the tables stay on the device until `bindings` closes."""

    def __init__(self, rasterizer: CudaRasterizer, table: SplatTable, view: BenchView, bindings: ExitStack) -> None:
        region = _region((view.camera.width_px, view.camera.height_px))
        self.view: CudaView = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera, region.astype(np.float32))
        self._rasterizer, self._table, self._pose = rasterizer, table, view.T_camera_world
        self._tiles = tiles_touching(region, _MARGIN_PX)
        bindings.enter_context(rasterizer.bind_tables(table.rows, table.first_moment, table.second_moment))

    def whole(self, iterations: int) -> float:
        """Run iterations over the whole image, synchronise and return the last loss."""
        return self._train(iterations, False, FULL_FRAME)

    def region(self, iterations: int) -> float:
        """Run iterations of the active phase, synchronise and return the last loss."""
        return self._train(iterations, True, Subset(tiles=self._tiles))

    def _train(self, iterations: int, masked: bool, subset: Subset) -> float:
        table = self._table
        for _ in range(iterations):
            report = self._rasterizer.step(
                table.rows,
                table.first_moment,
                table.second_moment,
                view=self.view,
                T_camera_world=self._pose,
                loss=_LOSS,
                adam=ZERO_LEARNING_RATES,
                masked=masked,
                subset=subset,
            )
        return report.loss


def _measure_interleaved(contenders: Mapping[str, Callable[[int], float]], repetitions: int) -> dict[str, list[float]]:
    """Return the seconds per iteration in each batch of each contender, after a warm-up batch."""
    runs = min(RUNS_PER_BATCH, repetitions)
    for train in contenders.values():
        train(runs)
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(max(1, repetitions // runs)):
        for name, train in contenders.items():
            started_s = time.perf_counter()
            train(runs)
            seconds[name].append((time.perf_counter() - started_s) / runs)
    return seconds


def _region(size: tuple[int, int]) -> Bool[ndarray, "h w"]:
    """Return the mask of a fifth of the image, in its centre."""
    width, height = size
    margin = (1.0 - _REGION_SHARE**0.5) / 2.0
    region = np.zeros((height, width), np.bool_)
    left, top = round(margin * width), round(margin * height)
    region[top : height - top, left : width - left] = True
    return region


def _table(count: int) -> SplatTable:
    table = SplatTable(count)
    none = np.zeros(count, np.bool_)
    table.append(rows_to_gaussians(seed_rows(count), none, none.astype(np.uint32), none.astype(np.int16)))
    return table
