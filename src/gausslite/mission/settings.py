"""How one robot maps: what it knows of the place, what finds its nouns, and what its map may cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from gausslite.calibration.view_fit import PoseExposurePrior
from gausslite.datasets.source import Source
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.errors import InvalidInputError
from gausslite.mapping.policies import disable, policy
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.render.cpu_kernels import MAX_THREADS

DEFAULT_MAX_GAUSSIANS = 150_000
"""What two cores keep busy at 640x480; the paper's cap of a million is for a GPU."""
_PACE = SchedulerSettings()


def require_rate(rate_hz: float) -> None:
    """Raise InvalidInputError for no number of frames a second."""
    if not 0.01 <= rate_hz <= 1000:
        raise InvalidInputError(f"rate: expected 0.01 to 1000 Hz, got {rate_hz}")


@dataclass(frozen=True, slots=True)
class SceneKnowledge:
    """What is known of a place before the robot looks: which way is up and, in tests, where the objects are."""

    up_axis: UpAxis = (0.0, 0.0, 1.0)
    regions: Mapping[str, Region] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source) -> SceneKnowledge:
        """What a sequence says about its place."""
        return cls(source.up_axis, source.regions())


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """What finds the task's nouns: a YOLO-seg or Grounding DINO file, or ground truth without one.

    segmenter names what outlines detected boxes: "yolo", "depth" or a FastSAM file; None takes the model's own masks or depth.
    vocabulary is Grounding DINO's; None looks for vocab.txt beside the model.

    resegment runs the network on frames between detections too; without it masks are cut by depth inside the
    re-projected boxes, which on a real kitchen is as exact at a third of the time. With beside, mapping does not wait
    for detections: they run on a thread of their own and count from when they are there.
    """

    model: Path | None = None
    resegment: bool = False
    threads: int | None = None
    beside: bool = False
    segmenter: str | None = None
    vocabulary: Path | None = None


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """How one robot maps.

    without switches parts of the policy off by name (see `gausslite.mapping.policies.without`). rate_hz, when given,
    replaces the fixed number of iterations by what fits into 1 / rate_hz seconds a frame; where that is less than
    min_iterations, the skip_stages give way, and a frame may be late by the share deadline_slack of its time. pose_prior: how
    wrong poses and colours of frames may be.
    """

    policy: str = "task"
    without: frozenset[str] = frozenset()
    max_gaussians: int = DEFAULT_MAX_GAUSSIANS
    iterations: int | None = None
    rate_hz: float | None = None
    min_iterations: int = _PACE.min_iterations
    skip_stages: tuple[SkippableStage, ...] = _PACE.skip_stages
    deadline_slack: float = _PACE.deadline_slack
    seed: int = 0
    threads: int | None = None
    backend: str = "auto"
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)

    def __post_init__(self) -> None:
        if self.rate_hz is not None:
            require_rate(self.rate_hz)
        if not 0 <= self.min_iterations <= 10_000:
            raise InvalidInputError(f"least iterations: expected 0 to 10000, got {self.min_iterations}")
        if not 0 <= self.deadline_slack <= 1:
            raise InvalidInputError(f"run over: expected a share of a frame's time, 0 to 1, got {self.deadline_slack}")
        if self.iterations is not None and not 0 <= self.iterations <= 10_000:
            raise InvalidInputError(f"iterations: expected 0 to 10000, got {self.iterations}")
        if not 0 <= self.seed < 1 << 32:
            raise InvalidInputError(f"seed: expected 0 to {(1 << 32) - 1}, got {self.seed}")
        if self.threads is not None and not 1 <= self.threads <= MAX_THREADS:
            raise InvalidInputError(f"threads: expected 1 to {MAX_THREADS}, got {self.threads}")
        # an unknown policy or component, or a cap of nothing
        self.mapper_settings()

    @property
    def pace(self) -> SchedulerSettings | None:
        """The time a frame may take and what it goes without when short; None where iterations are counted instead."""
        if self.rate_hz is None:
            return None
        return SchedulerSettings(1.0 / self.rate_hz, self.min_iterations, self.skip_stages, self.deadline_slack)

    def mapper_settings(self) -> MapperSettings:
        """The named policy with this mission's cap, iterations and switches."""
        base = disable(policy(self.policy), self.without)
        optimization = base.optimization
        if self.iterations is not None:
            optimization = optimization.with_iterations(self.iterations)
        return replace(base, max_gaussians=self.max_gaussians, optimization=optimization, pose_prior=self.pose_prior)
