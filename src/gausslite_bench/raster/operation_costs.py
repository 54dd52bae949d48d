"""Times of a rasterizer's operations, as the mapper calls them: a training step, the image, its gradients."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.config.option import option
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.choose import choose_rasterizer
from gausslite.render.cpu import CpuRasterizer, usable_simd
from gausslite.render.rasterizer import FULL_FRAME, TILE_PX, AdamSettings, LossWeights, Rasterizer, Subset
from gausslite_bench.cli.study_options import read_image_size
from gausslite_bench.raster.room import held_out_frame, seed_rows
from gausslite_bench.report import Report

_LOSSES = {
    "fused_l1": LossWeights(colour=0.8, depth=1.0, ssim=0.0),
    "fused_l1_ssim": LossWeights(colour=0.8, depth=1.0, ssim=0.2),
}
"""Losses of the two kinds of iteration; with L1 only, forward, loss and backward are one pass."""
_STILL = AdamSettings(means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0, rgb=0.0)
"""Adam runs in full but changes no parameter, so that every run does the same work."""
_REGION_SHARE = 0.2
_RUNS_PER_BATCH = 10
"""Consecutive runs of one operation before the next operation: other load on the machine then affects all alike."""
_WARM_UP = 3


def read_image_sizes(texts: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Return the sizes of "WxH". Raises InvalidInputError."""
    return tuple(map(read_image_size, texts))


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """The options of `bench raster`: every image size with every number of Gaussians and every instruction set."""

    sizes: tuple[tuple[int, int], ...] = option(
        ((320, 240), (640, 480)),
        "image sizes (default: 320x240,640x480)",
        metavar="WxH,...",
        plain_type=tuple[str, ...],
        convert=read_image_sizes,
    )
    gaussians: tuple[int, ...] = option((20_000, 100_000, 300_000), "numbers of Gaussians", metavar="N,...")
    threads: int | None = option(None, "threads (default: all available cores)", low=1)
    simd: str | None = option(None, "instruction set, or all (default: the fastest supported one)", metavar="NAME")
    reps: int = option(60, "timed runs of each operation", low=1, high=100_000)


@dataclass(frozen=True, slots=True)
class GpuSettings:
    """The options of `bench gpu`."""

    gaussians: tuple[int, ...] = option(
        (100_000, 300_000, 1_000_000, 3_000_000), "numbers of Gaussians", metavar="N,..."
    )
    reps: int = option(100, "timed runs of each operation", low=1, high=100_000)


def run_raster(settings: RasterSettings) -> Report:
    """Measure every case on the CPU. Raises KernelError, InvalidInputError."""
    sets = usable_simd() if settings.simd == "all" else (settings.simd,)
    cases: list[dict[str, object]] = []
    for size in settings.sizes:
        for simd in sets:
            rasterizer = CpuRasterizer(settings.threads, simd)
            machine = {"simd": rasterizer.simd, "threads": rasterizer.threads}
            cases += [{**machine, **case} for case in _cases(rasterizer, size, settings.gaussians, settings.reps)]
    return Report({"cases": cases})


def run_gpu(settings: GpuSettings) -> Report:
    """Measure this machine's GPU. Raises KernelError without a usable one."""
    rasterizer = choose_rasterizer("cuda")
    return Report(
        {"backend": rasterizer.name, "cases": _cases(rasterizer, (640, 480), settings.gaussians, settings.reps)}
    )


def _cases(rasterizer: Rasterizer, size: tuple[int, int], counts: Sequence[int], reps: int) -> list[dict[str, object]]:
    view = held_out_frame(*size)
    return [
        {"gaussians": count, "size": list(size), "operations": operation_times(rasterizer, count, view, reps)}
        for count in counts
    ]


def operation_times(rasterizer: Rasterizer, count: int, view: Frame, repetitions: int) -> dict[str, dict[str, float]]:
    """Return the minimum and the median of each operation in milliseconds; region: a step on a fifth of the image."""
    table = SplatTable(count)
    table.append_rows(
        seed_rows(count), np.zeros(count, np.bool_), np.zeros(count, np.uint32), np.full(count, -1, np.int16)
    )
    operations = _operations(rasterizer, table, view)
    seconds: dict[str, list[float]] = {name: [] for name in operations}
    with rasterizer.bind_tables(table.rows, table.first_moment, table.second_moment):
        for done in range(0, repetitions, _RUNS_PER_BATCH):
            for name, operation in operations.items():
                seconds[name] += _measure_seconds(operation, min(_RUNS_PER_BATCH, repetitions - done))
    return {
        name: {"min_ms": 1e3 * min(times), "median_ms": 1e3 * float(np.median(times))}
        for name, times in seconds.items()
    }


def _operations(rasterizer: Rasterizer, table: SplatTable, view: Frame) -> dict[str, Callable[[], object]]:
    height, width = view.depth_m.shape
    tiles = np.zeros((-(-height // TILE_PX), -(-width // TILE_PX)), np.bool_)
    top, left = (round((1.0 - _REGION_SHARE**0.5) / 2.0 * count) for count in tiles.shape)
    tiles[top : len(tiles) - top, left : tiles.shape[1] - left] = True
    pixels = tiles.repeat(TILE_PX, 0).repeat(TILE_PX, 1)[:height, :width].astype(np.float32)
    prepared = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera, pixels)
    step = functools.partial(
        rasterizer.step,
        *(table.rows, table.first_moment, table.second_moment, prepared, inverse(view.T_world_camera)),
        adam=_STILL,
    )
    d_rgb, d_depth_m = (np.full(image.shape, 1e-5, np.float32) for image in (view.rgb, view.depth_m))
    forward = functools.partial(rasterizer.forward, table.rows, view.camera, inverse(view.T_world_camera))
    return {
        **{name: functools.partial(step, loss=loss, subset=FULL_FRAME) for name, loss in _LOSSES.items()},
        "region": functools.partial(step, loss=_LOSSES["fused_l1_ssim"], masked=True, subset=Subset(tiles=tiles)),
        "forward": forward,
        "forward_backward": lambda: rasterizer.backward(forward(), d_rgb, d_depth_m, np.zeros_like(view.depth_m)),
    }


def _measure_seconds(operation: Callable[[], object], repetitions: int) -> list[float]:
    """Return the seconds of each run after the warm-up."""
    seconds = []
    for i in range(_WARM_UP + repetitions):
        started_s = time.perf_counter()
        operation()
        if i >= _WARM_UP:
            seconds.append(time.perf_counter() - started_s)
    return seconds
