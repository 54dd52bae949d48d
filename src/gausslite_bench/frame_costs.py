"""Time and results of each frame in one agent's mapping loop."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.training import SkippableStage, Stage
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.frame_scheduler import FrameScheduler, FrameTiming, SchedulerSettings
from gausslite.mission.runner import MissionRunner
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import RelevanceEstimator
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rasterizer


@dataclass(frozen=True, slots=True)
class Latency:
    """Percentiles of a duration over many frames, in milliseconds."""

    p50_ms: float
    p90_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Latency:
        """Return the interpolated percentiles of these times in seconds."""
        p50, p90, p99, highest = np.percentile(seconds, (50, 90, 99, 100)) * 1e3
        return cls(float(p50), float(p90), float(p99), float(highest))


@dataclass(frozen=True, slots=True)
class FrameCost:
    """Time and results of one mapped frame, from the image in memory to the voxel updates ready to send.

    iterations: training iterations. gaussians: size of the map after the frame. roi_share: share of the image's pixels
    inside the task's region, 0 to 1.
    """

    timing: FrameTiming
    iterations: int
    gaussians: int
    roi_share: float

    @classmethod
    def of(cls, outcome: FrameOutcome) -> FrameCost:
        """Return the cost of a mapped frame."""
        return cls(outcome.timing, outcome.iterations, outcome.gaussians, outcome.roi_share)

    @property
    def perception_s(self) -> float:
        """Seconds of relevance estimation."""
        return self.stage_s(Stage.RELEVANCE)

    @property
    def publishing_s(self) -> float:
        """Seconds of collecting the region's voxel updates."""
        return self.stage_s(Stage.PUBLISHING)

    @property
    def mapping_s(self) -> float:
        """Seconds of all other stages: rendering, seeding and training."""
        return self.timing.seconds - self.perception_s - self.publishing_s

    def stage_s(self, stage: Stage) -> float:
        """Return the seconds of one stage; 0 if the frame skipped it."""
        return self.timing.stages_s.get(stage, 0.0)


class CostLog:
    """Compact record of all frame costs: on a long run its memory must stay small compared with the loop's."""

    def __init__(self) -> None:
        self._numbers = array("d")

    def append(self, cost: FrameCost) -> None:
        """Add a frame."""
        timing = cost.timing
        self._numbers.extend((timing.seconds, timing.under_trained, cost.iterations, cost.gaussians, cost.roi_share))
        self._numbers.extend(stage in timing.skipped_stages for stage in SkippableStage)
        self._numbers.extend(map(cost.stage_s, Stage))

    def costs(self) -> list[FrameCost]:
        """Return all frames in order."""
        rows = np.asarray(self._numbers).reshape(-1, 5 + len(SkippableStage) + len(Stage))
        return [_cost_from_row(row) for row in rows.tolist()]


def _cost_from_row(row: list[float]) -> FrameCost:
    """Return the cost that CostLog stored as these numbers."""
    seconds, under_trained, iterations, gaussians, roi_share = row[:5]
    flags, times_s = row[5 : 5 + len(SkippableStage)], row[5 + len(SkippableStage) :]
    skipped_stages = frozenset(stage for stage, skipped in zip(SkippableStage, flags, strict=True) if skipped)
    stages_s = {stage: time_s for stage, time_s in zip(Stage, times_s, strict=True) if time_s > 0.0}
    timing = FrameTiming(seconds, stages_s, skipped_stages, bool(under_trained))
    return FrameCost(timing, int(iterations), int(gaussians), roi_share)


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """Statistics of a run. hz: the loop's rate without waiting for frames. gaussians: after the last frame.

    stages: time of each stage per frame. frames_under_trained: frames below the minimum of iterations.
    skipped_stages: number of frames that skipped the stage for lack of time. roi_share: mean share of the pixels that
    the task's region covers.
    """

    frames: int
    hz: float
    iterations_mean: float
    iterations_min: int
    latency: Latency
    perception: Latency
    mapping: Latency
    publishing: Latency
    stages: dict[str, Latency]
    frames_under_trained: int
    skipped_stages: dict[str, int]
    roi_share: float
    gaussians: int

    @classmethod
    def of(cls, costs: Sequence[FrameCost]) -> LoopTiming:
        """Return the statistics of these frames. Raises DatasetError without frames."""
        if not costs:
            raise DatasetError("bench: expected at least one frame with depth, got none")
        iterations = [cost.iterations for cost in costs]
        return cls(
            frames=len(costs),
            hz=len(costs) / sum(cost.timing.seconds for cost in costs),
            iterations_mean=float(np.mean(iterations)),
            iterations_min=min(iterations),
            latency=Latency.of([cost.timing.seconds for cost in costs]),
            perception=Latency.of([cost.perception_s for cost in costs]),
            mapping=Latency.of([cost.mapping_s for cost in costs]),
            publishing=Latency.of([cost.publishing_s for cost in costs]),
            stages={stage.value: Latency.of([cost.stage_s(stage) for cost in costs]) for stage in Stage},
            frames_under_trained=sum(cost.timing.under_trained for cost in costs),
            skipped_stages={
                stage.value: sum(stage in cost.timing.skipped_stages for cost in costs) for stage in SkippableStage
            },
            roi_share=float(np.mean([cost.roi_share for cost in costs])),
            gaussians=costs[-1].gaussians,
        )


class LoopBench:
    """An agent's mapping loop, including the collection of the region's voxel updates."""

    def __init__(
        self,
        estimator: RelevanceEstimator,
        mapper: GaussianMapper,
        grid: VoxelGrid,
        scheduler: SchedulerSettings | None = None,
    ) -> None:
        """Build the loop; without scheduler settings each frame runs a fixed number of iterations."""
        self._mapper = TaskMapper(estimator, mapper, SentVoxelTracker(grid), FrameScheduler(scheduler))

    def gaussians(self) -> Gaussians:
        """Return a copy of the map."""
        return self._mapper.gaussians()

    def run(self, frames: Iterable[Frame], on_frame: Callable[[FrameOutcome], None]) -> None:
        """Map all frames; on_frame gets each outcome. Raises GaussLiteError, KeyboardInterrupt."""
        MissionRunner(self._mapper.process, on_frame).run(frames).raise_if_stopped()


@dataclass(frozen=True, slots=True)
class Overhead:
    """Percentage of the iterations' time spent outside the kernels; None if no iteration of that kind ran."""

    all: float
    full_image: float | None
    region: float | None

    @classmethod
    def of(cls, costs: Sequence[FrameCost], rasterizer: Rasterizer) -> Overhead | None:
        """Return the overhead; None for backends other than cpu. The rasterizer must have run these frames only."""
        full_s, region_s = (sum(cost.stage_s(stage) for cost in costs) for stage in (Stage.WARM_UP, Stage.ACTIVE))
        if not isinstance(rasterizer, CpuRasterizer) or full_s + region_s == 0.0:
            return None
        return cls(
            all=100.0 * (1.0 - rasterizer.steps_s() / (full_s + region_s)),
            full_image=None if full_s == 0.0 else 100.0 * (1.0 - rasterizer.steps_s(masked=False) / full_s),
            region=None if region_s == 0.0 else 100.0 * (1.0 - rasterizer.steps_s(masked=True) / region_s),
        )
