"""One trial: a policy maps a scene with one seed within the budget; held-out views score the map."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from statistics import fmean
from typing import Any

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.mapping.policies import ABLATION_FLAGS, EXTENSION_FLAGS, PAPER_FLAGS, TASK
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.real_scenes import RealScenePlan
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene
from gausslite_evaluation.compare import MapScores, average, score_view
from gausslite_evaluation.lpips import Lpips
from gausslite_evaluation.views import render_fitted

ScenePlan = HomeScenePlan | RealScenePlan
"""Description of a scene before its frames are loaded."""


class BudgetMode(StrEnum):
    """Quantity per frame that is equal for all policies."""

    ITERATIONS = "iterations"
    TIME = "time"


@dataclass(frozen=True, slots=True)
class TrialBudget:
    """Limits for every policy: the number of Gaussians, and per frame the iterations or 1 / rate_hz seconds.

    rate_hz None with equal time: the rate must still be measured.
    """

    max_gaussians: int = 60_000
    equal: BudgetMode = BudgetMode.ITERATIONS
    iterations: int = 8
    rate_hz: float | None = None

    @property
    def needs_rate(self) -> bool:
        """True if time is equal and the rate is not known yet."""
        return self.equal is BudgetMode.TIME and self.rate_hz is None

    def __str__(self) -> str:
        """Return the limit per frame as text."""
        if self.equal is BudgetMode.ITERATIONS:
            return f"{self.iterations} iterations per frame"
        return "time" if self.rate_hz is None else f"{1e3 / self.rate_hz:.3g} ms per frame"


@dataclass(frozen=True, slots=True)
class Variant:
    """A policy with disabled components; label is its name in tables."""

    label: str
    policy: str
    disabled: frozenset[str] = frozenset()


def cumulative_variants() -> list[Variant]:
    """Return none, +SB, +MVO, +ROI, +SIS, +GFD, then the extensions; each variant keeps all previous components."""
    labels = [*(name.upper() for name in PAPER_FLAGS), *EXTENSION_FLAGS]
    rows = [Variant("none", TASK, frozenset(ABLATION_FLAGS))]
    return rows + [Variant(f"+{label}", TASK, frozenset(ABLATION_FLAGS[i + 1 :])) for i, label in enumerate(labels)]


@dataclass(frozen=True, slots=True)
class Conditions:
    """Settings shared by all trials of a study. size: (width_px, height_px)."""

    size: tuple[int, int]
    threads: int | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """One policy on one scene with one seed: everything that determines a result."""

    plan: ScenePlan
    variant: Variant
    budget: TrialBudget
    seed: int
    conditions: Conditions

    @property
    def mission(self) -> MissionSettings:
        """The mission's settings. Raises InvalidInputError for an unknown policy or component."""
        timed = self.budget.equal is BudgetMode.TIME
        return MissionSettings(
            policy=self.variant.policy,
            disabled=self.variant.disabled,
            max_gaussians=self.budget.max_gaussians,
            iterations=None if timed else self.budget.iterations,
            rate_hz=self.budget.rate_hz if timed else None,
            seed=self.seed,
            threads=self.conditions.threads,
            pose_prior=self.plan.pose_prior,
        )

    @property
    def follows_task(self) -> bool:
        """False if the policy ignores the task's region, so that its map is the same for every task."""
        return self.mission.mapper_settings().components.follow_task

    @property
    def key(self) -> str:
        """File name that is unique for the trial's settings, including those of the policy."""
        digest = self._digest(self.plan.settings())
        return f"{self.plan.name}-{self.variant.label}-{self.budget.equal}-{self.seed}-{digest}".replace("+", "with-")

    @property
    def map_key(self) -> str:
        """Digest of everything the map depends on; includes the task only if the policy follows it."""
        return self._digest(self.plan.settings() if self.follows_task else self.plan.training_settings())

    def _digest(self, scene: Mapping[str, object]) -> str:
        # the order of a set of names differs between processes; the mapper's settings show what is disabled
        settings = {
            "scene": dict(scene),
            "mission": str(replace(self.mission, disabled=frozenset())),
            "mapper": str(self.mission.mapper_settings()),
            "conditions": str(self.conditions),
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class MapCost:
    """Cost of a map. map_bytes: size of the whole map in messages. ms_per_frame: perception and mapping."""

    gaussians: int
    map_bytes: int
    iterations_mean: float
    ms_per_frame: float


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Result of a trial. roi_share: region's share of the held-out views.

    scores: where poses may be wrong, each view is fitted in pose and exposure first.
    """

    scores: MapScores
    roi_share: float
    cost: MapCost

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> TrialResult:
        """Return the result of `asdict`'s values. Raises TypeError, KeyError for other content."""
        return cls(MapScores(**stored["scores"]), stored["roi_share"], MapCost(**stored["cost"]))


def message_bytes(gaussians: Gaussians, grid: VoxelGrid) -> int:
    """Return the size of these Gaussians in an agent's messages."""
    parts = split_batch(group_by_voxel(gaussians, grid))
    return sum(len(encode_subset(RoiSubset("agent", "", 1, 1, part), grid)) for part in parts)


def build_map(trial: Trial, scene: Scene) -> tuple[Gaussians, MapCost]:
    """Return the map of the scene at the end of its mission, and its cost. Raises GaussLiteError."""
    settings = trial.mission
    # without a task if the policy ignores it, as ROI flags would affect eviction
    estimator = RecordedRelevanceEstimator(scene) if trial.follows_task else NoTaskEstimator()
    # CPU time with one thread, as other programs affect it less
    clock = time.process_time if settings.threads == 1 else time.perf_counter
    scheduler = FrameScheduler(settings.scheduler_settings, clock)
    loop = TaskMapper(estimator, build_mapper(settings), scheduler=scheduler)
    outcomes: list[FrameOutcome] = []
    MissionRunner(loop.process, outcomes.append).run(scene.training).raise_if_stopped()
    gaussians = loop.gaussians()
    iterations, seconds = zip(*((outcome.iterations, outcome.timing.seconds) for outcome in outcomes), strict=True)
    size = message_bytes(gaussians, VoxelGrid())
    return gaussians, MapCost(len(gaussians), size, fmean(iterations), 1e3 * fmean(seconds))


def evaluate_map(built: tuple[Gaussians, MapCost], trial: Trial, scene: Scene, lpips: Lpips | None) -> TrialResult:
    """Return the map's scores on the held-out views. Raises GaussLiteError."""
    gaussians, cost = built
    viewer = MapViewer(gaussians, choose_rasterizer(threads=trial.conditions.threads))
    render = partial(render_fitted, viewer) if trial.plan.pose_prior.has_pose_error else viewer.render_frame
    scores = average([score_view(render(view.frame), view, lpips) for view in scene.held_out])
    return TrialResult(scores, scene.roi_share, cost)
