"""Measure one robot's whole loop over a sequence: how long each frame takes, and what it got for it."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import DatasetError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.sent_voxels import SentVoxelTracker
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mission.frame_scheduler import FrameScheduler, FrameTiming, SchedulerSettings
from gausslite.mission.runner import MissionRunner
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance_estimator import RelevanceEstimator
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rasterizer


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
    """One mapped frame: its latency from the image in memory to the words that would leave the robot, and its steps."""

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
        """Seconds of attention."""
        return self.stage_s(Stage.RELEVANCE)

    @property
    def words_s(self) -> float:
        """Seconds that making the region's words took."""
        return self.stage_s(Stage.PUBLISHING)

    @property
    def mapping_s(self) -> float:
        """Seconds of all else: drawing, seeding and training."""
        return self.timing.seconds - self.perception_s - self.words_s

    def stage_s(self, step: Stage) -> float:
        """Seconds of one step; 0 where the frame went without it."""
        return self.timing.stages_s.get(step, 0.0)


class CostLog:
    """What each frame cost, as a few numbers: the memory of a long run is to be the loop's and not its record's."""

    def __init__(self) -> None:
        self._numbers = array("d")

    def append(self, cost: FrameCost) -> None:
        """Keep one more."""
        timing = cost.timing
        self._numbers.extend((timing.seconds, timing.under_trained, cost.iterations, cost.gaussians, cost.roi_share))
        self._numbers.extend(relief in timing.skipped_stages for relief in SkippableStage)
        self._numbers.extend(map(cost.stage_s, Stage))

    def costs(self) -> list[FrameCost]:
        """All that were kept, in order."""
        return [
            _cost_of(row)
            for row in np.asarray(self._numbers).reshape(-1, 5 + len(SkippableStage) + len(Stage)).tolist()
        ]


def _cost_of(row: list[float]) -> FrameCost:
    """A frame's cost from the numbers that the log keeps of it."""
    (seconds, short, iterations, gaussians, roi_share), beside = row[:5], row[5:]
    skipped_stages = frozenset(
        relief for relief, went_without in zip(SkippableStage, beside, strict=False) if went_without
    )
    steps_s = {step: step_s for step, step_s in zip(Stage, beside[len(SkippableStage) :], strict=True) if step_s > 0.0}
    return FrameCost(
        FrameTiming(seconds, steps_s, skipped_stages, bool(short)), int(iterations), int(gaussians), roi_share
    )


@dataclass(frozen=True, slots=True)
class LoopTiming:
    """The figures of a run. hz is what the loop sustains when frames are always at hand; the last frame's Gaussians.

    steps: each step's time in a frame. frames_short trained less than they should; skipped_stages counts the frames that
    went without something for want of time.
    """

    frames: int
    hz: float
    iterations_mean: float
    iterations_min: int
    latency: Latency
    perception: Latency
    mapping: Latency
    words: Latency
    steps: dict[str, Latency]
    frames_short: int
    skipped_stages: dict[str, int]
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
            hz=len(costs) / sum(cost.timing.seconds for cost in costs),
            iterations_mean=float(np.mean(iterations)),
            iterations_min=min(iterations),
            latency=Latency.of([cost.timing.seconds for cost in costs]),
            perception=Latency.of([cost.perception_s for cost in costs]),
            mapping=Latency.of([cost.mapping_s for cost in costs]),
            words=Latency.of([cost.words_s for cost in costs]),
            steps={step.value: Latency.of([cost.stage_s(step) for cost in costs]) for step in Stage},
            frames_short=sum(cost.timing.under_trained for cost in costs),
            skipped_stages={
                relief.value: sum(relief in cost.timing.skipped_stages for cost in costs) for relief in SkippableStage
            },
            roi_share=float(np.mean([cost.roi_share for cost in costs])),
            gaussians=costs[-1].gaussians,
        )


class LoopBench:
    """Runs the loop that a robot runs, region words included, and keeps what each frame cost."""

    def __init__(
        self,
        attention: RelevanceEstimator,
        mapper: GaussianMapper,
        grid: VoxelGrid,
        scheduler: SchedulerSettings | None = None,
    ) -> None:
        """With a scheduler each frame trains until its time is up, without one for a fixed number of iterations."""
        self._loop = TaskMapper(attention, mapper, SentVoxelTracker(grid), FrameScheduler(scheduler))

    def gaussians(self) -> Gaussians:
        """A copy of the map."""
        return self._loop.gaussians()

    def run(self, frames: Iterable[Frame], on_frame: Callable[[FrameOutcome], None]) -> None:
        """Map all frames; on_frame gets each outcome. Raises GaussLiteError, KeyboardInterrupt."""
        MissionRunner(self._loop.process, on_frame).run(frames).raise_if_stopped()


@dataclass(frozen=True, slots=True)
class Overhead:
    """The percentage of iterations' time that passes outside the kernels' steps; None where there was no such step."""

    all: float
    full_image: float | None
    region: float | None

    @classmethod
    def of(cls, costs: Sequence[FrameCost], rasterizer: Rasterizer) -> Overhead | None:
        """Of these frames, whose steps must be all that the rasterizer ever ran; None for a backend without a clock."""
        full_s, region_s = (sum(cost.stage_s(step) for cost in costs) for step in (Stage.WARM_UP, Stage.ACTIVE))
        if not isinstance(rasterizer, CpuRasterizer) or full_s + region_s == 0.0:
            return None
        return cls(
            all=100.0 * (1.0 - rasterizer.steps_s() / (full_s + region_s)),
            full_image=None if full_s == 0.0 else 100.0 * (1.0 - rasterizer.steps_s(masked=False) / full_s),
            region=None if region_s == 0.0 else 100.0 * (1.0 - rasterizer.steps_s(masked=True) / region_s),
        )
