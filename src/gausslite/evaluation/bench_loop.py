"""Measure one robot's whole loop over a sequence: how long each frame takes, and what it got for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import DatasetError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.roi import RoiLedger
from gausslite.perception.attention import Attention
from gausslite.pipeline import TaskMapper


@dataclass(frozen=True, slots=True)
class Latency:
    """How long something took over many frames, in milliseconds."""

    p50_ms: float
    p90_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Latency:
        """Percentiles of these times; between two frames they are interpolated."""
        p50, p90, p99, highest = np.percentile(seconds, (50, 90, 99, 100)) * 1e3
        return cls(float(p50), float(p90), float(p99), float(highest))


@dataclass(frozen=True, slots=True)
class FrameCost:
    """One mapped frame: seconds of attention, of drawing, seeding and training, and of making the region's words."""

    perception_s: float
    mapping_s: float
    words_s: float
    iterations: int
    gaussians: int
    roi_share: float

    @property
    def latency_s(self) -> float:
        """From the frame in memory to the words that would leave the robot."""
        return self.perception_s + self.mapping_s + self.words_s


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """The figures of a run. hz is what the loop sustains when frames are always at hand; the last frame's Gaussians."""

    frames: int
    hz: float
    iterations_mean: float
    iterations_min: int
    latency: Latency
    perception: Latency
    mapping: Latency
    words: Latency
    roi_share: float
    gaussians: int

    @classmethod
    def of(cls, costs: Sequence[FrameCost]) -> LoopTiming:
        """The figures of these frames. Raises DatasetError when there are none."""
        if not costs:
            raise DatasetError("bench: expected at least one frame with depth, got none")
        iterations = [cost.iterations for cost in costs]
        return cls(
            frames=len(costs),
            hz=len(costs) / sum(cost.latency_s for cost in costs),
            iterations_mean=float(np.mean(iterations)),
            iterations_min=min(iterations),
            latency=Latency.of([cost.latency_s for cost in costs]),
            perception=Latency.of([cost.perception_s for cost in costs]),
            mapping=Latency.of([cost.mapping_s for cost in costs]),
            words=Latency.of([cost.words_s for cost in costs]),
            roi_share=float(np.mean([cost.roi_share for cost in costs])),
            gaussians=costs[-1].gaussians,
        )


class LoopBench:
    """Runs the loop that a robot runs, with a clock between its steps."""

    def __init__(
        self, attention: Attention, mapper: GaussianMapper, grid: VoxelGrid, seconds_per_frame: float | None = None
    ) -> None:
        """With seconds_per_frame each frame trains until its time is up; words are made after that, as in a mission."""
        self._attention = _Clocked(attention)
        self._mapper = mapper
        self._loop = TaskMapper(self._attention, mapper, seconds_per_frame=seconds_per_frame)
        self._ledger = RoiLedger(grid)

    def process(self, frame: Frame) -> FrameCost | None:
        """What one frame cost; None when it was skipped for want of depth."""
        outcome = self._loop.process(frame)
        if outcome.skipped is not None:
            return None
        started_s = time.perf_counter()
        self._ledger.changed(self._mapper.roi_gaussians())
        words_s = time.perf_counter() - started_s
        perception_s = self._attention.latest_s
        mapping_s = outcome.seconds - perception_s
        return FrameCost(perception_s, mapping_s, words_s, outcome.iterations, outcome.gaussians, outcome.roi_share)


class _Clocked:
    """An Attention that remembers how long it took."""

    def __init__(self, inner: Attention) -> None:
        self._inner = inner
        self.latest_s = 0.0

    @property
    def notes(self) -> tuple[str, ...]:
        """The inner one's."""
        return self._inner.notes

    def attend(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceMap:
        """The inner one's relevance."""
        started_s = time.perf_counter()
        relevance = self._inner.attend(frame, rendered_depth_m)
        self.latest_s = time.perf_counter() - started_s
        return relevance
