"""Measure what one iteration of the CPU rasterizer costs, stage by stage, and beside another library if asked."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gausslite.errors import InvalidInputError
from gausslite.evaluation.bench_scene import BenchView, held_view, seed_rows
from gausslite.evaluation.bench_yardstick import Yardstick
from gausslite.optimize.parameters import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights, Rendering

SIZES = ((320, 240), (640, 480))
GAUSSIANS = (20_000, 100_000, 300_000)
OPERATIONS = ("fused_l1", "fused_l1_ssim", "forward", "backward")
_RESTING = AdamSettings(means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0, rgb=0.0)
_L1 = LossWeights(colour=0.8, depth=1.0, ssim=0.0)
_L1_SSIM = LossWeights(colour=0.8, depth=1.0, ssim=0.2)
_WARM_UP = 3
_TURN = 10
_SETTLE_S = 0.02


@dataclass(frozen=True, slots=True)
class Duration:
    """Milliseconds of many runs of one thing."""

    min_ms: float
    median_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Duration:
        """Minimum and median of these times."""
        return cls(float(np.min(seconds)) * 1e3, float(np.median(seconds)) * 1e3)


@dataclass(frozen=True, slots=True)
class RasterTiming:
    """What each operation took, whole calls as the mapper pays for them; stages_ms of each fused step: minima.

    yardstick is the other library's, empty when none was measured.
    """

    gaussians: int
    width: int
    height: int
    threads: int
    simd: str
    durations: Mapping[str, Duration]
    stages_ms: Mapping[str, Mapping[str, float]]
    yardstick: Mapping[str, Duration] = field(default_factory=dict)

    def as_json(self) -> dict[str, object]:
        """One flat record for scripts."""
        case = {name: getattr(self, name) for name in ("gaussians", "width", "height", "threads", "simd")}
        minima = {f"{name}_ms_min": self.durations[name].min_ms for name in OPERATIONS}
        medians = {f"{name}_ms_median": self.durations[name].median_ms for name in OPERATIONS}
        others = {f"yardstick_{name}_ms_min": duration.min_ms for name, duration in self.yardstick.items()}
        return {**case, **minima, **medians, **others, "stages_ms_min": self.stages_ms}


@dataclass(frozen=True, slots=True)
class RasterBench:
    """What to measure: every size with every number of Gaussians and every instruction set (None: the fastest).

    repetitions counts the timed runs of each operation; threads None means one per core allowed.
    """

    sizes: Sequence[tuple[int, int]] = SIZES
    gaussians: Sequence[int] = GAUSSIANS
    simd: Sequence[str | None] = (None,)
    threads: int | None = None
    repetitions: int = 60
    yardstick: Path | None = None

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
        contenders: list[_Ours | Yardstick] = [ours]
        with ExitStack() as at_end:
            if self.yardstick is not None:
                other = Yardstick(self.yardstick, rasterizer.threads, _table(table.count), view)
                at_end.callback(other.close)
                contenders.append(other)
            seconds = _take_turns(contenders, self.repetitions)
        durations = [{name: Duration.of(times) for name, times in each.items()} for each in seconds]
        return RasterTiming(
            gaussians=table.count,
            width=view.camera.width_px,
            height=view.camera.height_px,
            threads=rasterizer.threads,
            simd=rasterizer.simd,
            durations=durations[0],
            stages_ms=ours.stages_ms,
            yardstick=durations[1] if self.yardstick is not None else {},
        )


class _Ours:
    """The operations of our rasterizer on one case; remembers the least time of every stage."""

    def __init__(self, rasterizer: CpuRasterizer, table: SplatTable, view: BenchView) -> None:
        self.stages_ms: dict[str, dict[str, float]] = {}
        self._rasterizer = rasterizer
        self._table = table
        self._view = view
        self._training_view = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera)
        self._drawn: Rendering = self._draw()
        self._d_rgb = np.full(view.rgb.shape, 1e-5, np.float32)
        self._d_depth_m = np.full(view.depth_m.shape, 1e-5, np.float32)
        self._d_alpha = np.zeros(view.depth_m.shape, np.float32)

    def fused_l1(self) -> None:
        """One whole iteration with L1 on colour and depth."""
        self._step("fused_l1", _L1)

    def fused_l1_ssim(self) -> None:
        """One whole iteration with SSIM too."""
        self._step("fused_l1_ssim", _L1_SSIM)

    def forward(self) -> None:
        """Draw."""
        self._drawn = self._draw()

    def backward(self) -> None:
        """From gradients of the image to gradients of the rows; after `forward`."""
        self._rasterizer.backward(self._drawn, self._d_rgb, self._d_depth_m, self._d_alpha)

    def _draw(self) -> Rendering:
        return self._rasterizer.forward(self._table.rows, self._view.camera, self._view.T_camera_world)

    def _step(self, name: str, loss: LossWeights) -> None:
        table = self._table
        moments = (table.first_moment, table.second_moment)
        pose = self._view.T_camera_world
        self._rasterizer.step(table.rows, *moments, self._training_view, pose, loss, _RESTING)
        least = self.stages_ms.setdefault(name, {})
        for stage, ms in self._rasterizer.stage_times_ms().items():
            least[stage] = min(ms, least.get(stage, ms))


def _table(count: int) -> SplatTable:
    table = SplatTable(count)
    table.append_rows(
        seed_rows(count), np.zeros(count, np.bool_), np.zeros(count, np.uint32), np.full(count, -1, np.int16)
    )
    return table


def _take_turns(contenders: Sequence[_Ours | Yardstick], repetitions: int) -> list[dict[str, list[float]]]:
    """Seconds of `repetitions` runs of each operation of each contender, in turns of ten."""
    seconds: list[dict[str, list[float]]] = [{name: [] for name in OPERATIONS} for _ in contenders]
    for done in range(0, repetitions, _TURN):
        turn = min(_TURN, repetitions - done)
        for contender, times in zip(contenders, seconds, strict=True):
            # idle threads of the one before may still be spinning on our cores
            time.sleep(_SETTLE_S)
            for fused in ("fused_l1", "fused_l1_ssim"):
                times[fused] += _timed([getattr(contender, fused)], turn)[0]
            forward, backward = _timed([contender.forward, contender.backward], turn)
            times["forward"] += forward
            times["backward"] += backward
    return seconds


def _timed(operations: Sequence[Callable[[], None]], repetitions: int) -> list[list[float]]:
    """Seconds of each run of each of these operations, one after the other, once all are warm."""
    seconds: list[list[float]] = [[] for _ in operations]
    for i in range(_WARM_UP + repetitions):
        for operation, times in zip(operations, seconds, strict=True):
            started_s = time.perf_counter()
            operation()
            if i >= _WARM_UP:
                times.append(time.perf_counter() - started_s)
    return seconds
