"""Measure the cuda backend: iterations a second beside gsplat called plainly, and a whole frame on a large map."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.errors import InvalidInputError
from gausslite.mapping.keyframes import tiles_of
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.optimize.density import DensitySettings
from gausslite.optimize.parameters import SplatTable, rows_to_gaussians
from gausslite.render.rasterizer import FULL_FRAME, Subset
from gausslite_bench.raster.procedural_room import BenchView, held_view, seed_rows
from gausslite_bench.raster.repeated_step import LOSSES, RESTING, TURN, Duration

if TYPE_CHECKING:
    from gausslite.render.cuda import CudaRasterizer
    from gausslite.render.cuda.gsplat_baseline import Rasterization
    from gausslite.render.cuda.loss import CudaView

GPU_GAUSSIANS = (100_000, 300_000, 1_000_000, 3_000_000)
FRAME_GAUSSIANS = 1_000_000
PAPERS_FRAME_MS = 500.0
_LOSS = LOSSES["fused_l1_ssim"]
_REGION_SHARE = 0.2
_MARGIN_PX = 5
_ROOM_TO_GROW = 1.1
_FRAME_WARM_UP = 2


@dataclass(frozen=True, slots=True)
class StepRate:
    """Iterations a second at one size of map, best and median of turns: over the whole image, in a region of a fifth
    of it, and of gsplat called plainly over the whole image.
    """

    gaussians: int
    width: int
    height: int
    best: Mapping[str, float]
    median: Mapping[str, float]

    def as_json(self) -> dict[str, object]:
        """One record for scripts."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class FrameCost:
    """A mapped frame on a map of this many: seeding, the iterations of the settings, density control, all transfers."""

    gaussians: int
    iterations: int
    whole: Duration
    steps_ms: Mapping[str, float]

    def as_json(self) -> dict[str, object]:
        """One record for scripts."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class GpuBench:
    """What to measure. rasterization stands in for gsplat's own where there is no GPU, which only tests do."""

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
        """Iterations a second, one size of map after the other. Raises KernelError."""
        view = held_view(*self.size)
        for count in self.gaussians:
            with ExitStack() as at_end:
                ours = _Ours(self.rasterizer, _table(count), view, at_end)
                contenders = {"whole": ours.whole, "region": ours.region, "gsplat": self._plainly(count, view, ours)}
                seconds = _take_turns(contenders, self.repetitions)
            yield StepRate(
                count,
                *self.size,
                best={name: 1.0 / min(times) for name, times in seconds.items()},
                median={name: 1.0 / float(np.median(times)) for name, times in seconds.items()},
            )

    def frame(self) -> FrameCost:
        """Map the same view again and again, with density control in every frame. Raises KernelError."""
        view = held_view(*self.size)
        settings = MapperSettings(
            max_gaussians=int(self.frame_gaussians * _ROOM_TO_GROW),
            density=DensitySettings(densify_every=MapperSettings().optimization.iterations, prune_every=8),
        )
        mapper = GaussianMapper(settings, self.rasterizer, known=_table(self.frame_gaussians).to_gaussians())
        scheduler, weight = FrameScheduler(), _region(self.size).astype(np.float32)
        relevance = RelevanceMap(weight, np.where(weight > 0, 0, -1).astype(np.int16))
        budgets, iterations = [], 0
        for index in range(_FRAME_WARM_UP + self.frames):
            frame = Frame(index, index, view.rgb, view.depth_m, view.camera, inverse(view.T_camera_world))
            scheduler.begin()
            iterations = mapper.map_frame(frame, relevance, scheduler).iterations
            budgets.append(scheduler.end())
        timed = budgets[_FRAME_WARM_UP:]
        steps = {step for budget in timed for step in budget.stages_s}
        return FrameCost(
            mapper.count,
            iterations,
            Duration.of([budget.seconds for budget in timed]),
            {str(step): 1e3 * float(np.median([b.stages_s.get(step, 0.0) for b in timed])) for step in sorted(steps)},
        )

    def _plainly(self, count: int, view: BenchView, ours: _Ours) -> Callable[[int], float]:
        from gausslite.render.cuda.gsplat_baseline import GsplatBaseline, load_gsplat_rasterization

        draw = self.rasterization or load_gsplat_rasterization()
        return GsplatBaseline(seed_rows(count), ours.view, view.T_camera_world, _LOSS, draw).train


class _Ours:
    """Steps of the cuda backend on tables that stay on the device until `at_end`."""

    def __init__(self, rasterizer: CudaRasterizer, table: SplatTable, view: BenchView, at_end: ExitStack) -> None:
        region = _region((view.camera.width_px, view.camera.height_px))
        self.view: CudaView = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera, region.astype(np.float32))
        self._rasterizer, self._table, self._pose = rasterizer, table, view.T_camera_world
        self._tiles = tiles_of(region, _MARGIN_PX)
        at_end.enter_context(rasterizer.bind_tables(table.rows, table.first_moment, table.second_moment))

    def whole(self, iterations: int) -> float:
        """So many iterations over the whole image, waited for; the last one's loss."""
        return self._train(iterations, False, FULL_FRAME)

    def region(self, iterations: int) -> float:
        """So many iterations of the active phase, waited for; the last one's loss."""
        return self._train(iterations, True, Subset(tiles=self._tiles))

    def _train(self, iterations: int, masked: bool, subset: Subset) -> float:
        table = self._table
        for _ in range(iterations):
            report = self._rasterizer.step(
                table.rows,
                table.first_moment,
                table.second_moment,
                self.view,
                self._pose,
                _LOSS,
                RESTING,
                masked,
                subset,
            )
        return report.loss


def _take_turns(contenders: Mapping[str, Callable[[int], float]], repetitions: int) -> dict[str, list[float]]:
    """Seconds an iteration in each turn of each contender, once all are warm."""
    turn = min(TURN, repetitions)
    for train in contenders.values():
        train(turn)
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(max(1, repetitions // turn)):
        for name, train in contenders.items():
            started_s = time.perf_counter()
            train(turn)
            seconds[name].append((time.perf_counter() - started_s) / turn)
    return seconds


def _region(size: tuple[int, int]) -> Bool[ndarray, "h w"]:
    """A fifth of the image, in its middle."""
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
