"""Cost of rendering a moving camera in a training step: rolling shutter and motion blur in the projection."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.domain.camera import CameraMotion
from gausslite.domain.pose import Twist
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.cpu import CpuRasterizer
from gausslite_bench.raster.procedural_room import BenchView
from gausslite_bench.raster.repeated_step import LOSSES, RUNS_PER_BATCH, Duration, RepeatedStep, measure_seconds

_TWIST = Twist(np.array([0.3, -0.1, 0.2]), np.radians([15.0, 55.0, -10.0]))
MOTIONS: Mapping[str, CameraMotion] = {
    "shutter": CameraMotion(_TWIST, readout_s=0.03),
    "shutter+blur": CameraMotion(_TWIST, readout_s=0.03, exposure_s=0.01),
}
"""A hand-held camera at 58 degrees a second."""


@dataclass(frozen=True, slots=True)
class MotionCost:
    """Times of a step with a moving camera and of an interleaved step with a camera at rest, over the whole image."""

    motion: str
    loss: str
    moving: Duration
    still: Duration

    @property
    def ratio(self) -> float:
        """Minimum time with motion divided by that without."""
        return self.moving.min_ms / self.still.min_ms


def motion_costs(
    rasterizer: CpuRasterizer, table: SplatTable, view: BenchView, repetitions: int
) -> tuple[MotionCost, ...]:
    """Return the costs of each motion with both losses."""
    steps = [RepeatedStep(rasterizer, table, view, motion=motion) for motion in (None, *MOTIONS.values())]
    costs = []
    for name in LOSSES:
        seconds: list[list[float]] = [[] for _ in steps]
        for done in range(0, repetitions, RUNS_PER_BATCH):
            for times, measured in zip(
                seconds, _run(steps, name, min(RUNS_PER_BATCH, repetitions - done)), strict=True
            ):
                times += measured
        still, *moving = (Duration.of(times) for times in seconds)
        costs += [MotionCost(motion, name, duration, still) for motion, duration in zip(MOTIONS, moving, strict=True)]
    return tuple(costs)


def _run(steps: Sequence[RepeatedStep], loss: str, repetitions: int) -> list[list[float]]:
    """Return the seconds of this many alternating runs of each step."""
    with steps[0].bind_tables():
        return measure_seconds([functools.partial(step, LOSSES[loss]) for step in steps], repetitions)
