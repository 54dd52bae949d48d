"""Repeatable training step of the rasterizer benchmarks, and timing of repeated runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.camera import CameraMotion
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import FULL_FRAME, AdamSettings, LossWeights, Subset
from gausslite_bench.raster.procedural_room import BenchView

LOSSES = {
    "fused_l1": LossWeights(colour=0.8, depth=1.0, ssim=0.0),
    "fused_l1_ssim": LossWeights(colour=0.8, depth=1.0, ssim=0.2),
}
"""Losses of the two kinds of iteration; with L1 only, forward, loss and backward are one pass."""

RUNS_PER_BATCH = 10
"""Consecutive runs of one operation before the next operation: other load on the machine then affects all alike."""

ZERO_LEARNING_RATES = AdamSettings(means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0, rgb=0.0)
"""Adam runs in full but changes no parameter."""
_WARM_UP = 3


@dataclass(frozen=True, slots=True)
class Duration:
    """Minimum and median time of many runs, in milliseconds."""

    min_ms: float
    median_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Duration:
        """Return minimum and median of these times in seconds."""
        return cls(float(np.min(seconds)) * 1e3, float(np.median(seconds)) * 1e3)

    @classmethod
    def mean(cls, durations: Sequence[Duration]) -> Duration:
        """Return the mean of the minima and the mean of the medians."""
        return cls(
            float(np.mean([duration.min_ms for duration in durations])),
            float(np.mean([duration.median_ms for duration in durations])),
        )


class RepeatedStep:
    """A whole training iteration with zero learning rates: every run does the same work.

    tiles: tiles to render and train; `pixels` masks the loss. None means the whole image without a mask. motion: that
    of the camera, None for a camera at rest.
    """

    def __init__(
        self,
        rasterizer: CpuRasterizer,
        table: SplatTable,
        view: BenchView,
        pixels: Bool[ndarray, "h w"] | None = None,
        tiles: Bool[ndarray, "th tw"] | None = None,
        *,
        motion: CameraMotion | None = None,
    ) -> None:
        self._rasterizer = rasterizer
        self._tables = table.rows, table.first_moment, table.second_moment
        self._pose = view.T_camera_world
        pixel_weights = None if pixels is None else pixels.astype(np.float32)
        self._view = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera, pixel_weights, motion)
        self._masked = pixels is not None
        self._subset = FULL_FRAME if tiles is None else Subset(tiles=tiles)

    def bind_tables(self) -> AbstractContextManager[None]:
        """Bind the tables for many iterations, as the mapper does."""
        return self._rasterizer.bind_tables(*self._tables)

    def __call__(self, loss: LossWeights) -> None:
        """Run one iteration."""
        self._rasterizer.step(
            *self._tables,
            view=self._view,
            T_camera_world=self._pose,
            loss=loss,
            adam=ZERO_LEARNING_RATES,
            masked=self._masked,
            subset=self._subset,
        )


def measure_seconds(operations: Sequence[Callable[[], None]], repetitions: int) -> list[list[float]]:
    """Return the seconds of each run of each operation after the warm-up; the operations alternate."""
    seconds: list[list[float]] = [[] for _ in operations]
    for i in range(_WARM_UP + repetitions):
        for operation, times in zip(operations, seconds, strict=True):
            started_s = time.perf_counter()
            operation()
            if i >= _WARM_UP:
                times.append(time.perf_counter() - started_s)
    return seconds
