"""One training step as the rasterizer's benchmark repeats it, and the clock round it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.optimize.parameters import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import FULL_FRAME, AdamSettings, LossWeights, Subset
from gausslite_bench.raster.procedural_room import BenchView

LOSSES = {
    "fused_l1": LossWeights(colour=0.8, depth=1.0, ssim=0.0),
    "fused_l1_ssim": LossWeights(colour=0.8, depth=1.0, ssim=0.2),
}
"""The two kinds of iteration; with L1 alone drawing, loss and walking back are one pass."""

TURN = 10
"""Runs of one thing before the next has its turn, so that a busy minute of the machine strikes all of them."""

RESTING = AdamSettings(means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0, rgb=0.0)
"""Adam does all its work and moves nothing."""
_WARM_UP = 3


@dataclass(frozen=True, slots=True)
class Duration:
    """Milliseconds of many runs of one thing."""

    min_ms: float
    median_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Duration:
        """Minimum and median of these times."""
        return cls(float(np.min(seconds)) * 1e3, float(np.median(seconds)) * 1e3)

    @classmethod
    def mean(cls, durations: Sequence[Duration]) -> Duration:
        """Of several things: the mean of their minima, and of their medians."""
        return cls(
            float(np.mean([each.min_ms for each in durations])), float(np.mean([each.median_ms for each in durations]))
        )


class RestingStep:
    """Whole iterations with learning rates of zero: the splats stay, so every run does the same work.

    tiles: what is drawn and trained on, and the loss is masked to; None is the whole image without a mask.
    """

    def __init__(
        self,
        rasterizer: CpuRasterizer,
        table: SplatTable,
        view: BenchView,
        pixels: Bool[ndarray, "h w"] | None = None,
        tiles: Bool[ndarray, "th tw"] | None = None,
    ) -> None:
        self._rasterizer = rasterizer
        self._lent = table.rows, table.first_moment, table.second_moment
        self._pose = view.T_camera_world
        weight = None if pixels is None else pixels.astype(np.float32)
        self._view = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera, weight)
        self._masked = pixels is not None
        self._subset = FULL_FRAME if tiles is None else Subset(tiles=tiles)

    def bind_tables(self) -> AbstractContextManager[None]:
        """Lend the tables for many iterations, as the mapper does."""
        return self._rasterizer.bind_tables(*self._lent)

    def __call__(self, loss: LossWeights) -> None:
        """One iteration."""
        self._rasterizer.step(
            *self._lent,
            self._view,
            self._pose,
            loss,
            RESTING,
            self._masked,
            self._subset,
        )


def timed(operations: Sequence[Callable[[], None]], repetitions: int) -> list[list[float]]:
    """Seconds of each run of each of these operations, one after the other, once all are warm."""
    seconds: list[list[float]] = [[] for _ in operations]
    for i in range(_WARM_UP + repetitions):
        for operation, times in zip(operations, seconds, strict=True):
            started_s = time.perf_counter()
            operation()
            if i >= _WARM_UP:
                times.append(time.perf_counter() - started_s)
    return seconds
