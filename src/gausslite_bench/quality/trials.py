"""One trial: a policy maps a scene with one seed within the budget; held-out views score the map."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from statistics import fmean
from typing import Any

from jaxtyping import UInt8
from numpy import ndarray

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.mission.build import EstimatorFactory, build_mapper
from gausslite.mission.frame_scheduler import Clock, FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import NoTaskEstimator, RelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene, ScenePlan
from gausslite_evaluation.compare import MapScores, average, score_view
from gausslite_evaluation.lpips import Lpips
from gausslite_evaluation.pictures import to_uint8
from gausslite_evaluation.views import largest_roi_views, render_fitted, render_fitted_at_region

SHEET_VIEWS = 2


class BudgetMode(StrEnum):
    """Quantity per frame that is equal for all policies."""

    ITERATIONS = "iterations"
    TIME = "time"


@dataclass(frozen=True, slots=True)
class TrialBudget:
    """Limits for every policy: the number of Gaussians, and per frame the iterations or 1 / rate_hz seconds.

    rate_hz None with equal time: the rate must still be measured (`equal_time`).
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


@dataclass(frozen=True, slots=True)
class PerceptionMode:
    """Source of the task's region: ground-truth masks, or perception from the task's text.

    from_text without a detector model: the text's nouns select among the scene's ground-truth objects.
    """

    from_text: bool = False
    detector: PerceptionSettings = field(default_factory=PerceptionSettings)


@dataclass(frozen=True, slots=True)
class Conditions:
    """Settings shared by all trials of a study. size: (width_px, height_px)."""

    size: tuple[int, int]
    perception: PerceptionMode = field(default_factory=PerceptionMode)
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
            pose_prior=self.plan.pose_policy.pose_prior,
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
class TrialResult:
    """Result of a trial. roi_share: region's share of the held-out views. map_bytes: size of the whole map in messages.

    ms_per_frame: perception and mapping. fitted: scores after fitting each view's pose and exposure; region_fitted:
    fitted at the region alone, on the views that show it. None if that was not requested, or if no view shows it.
    """

    scores: MapScores
    fitted: MapScores | None
    roi_share: float
    gaussians: int
    map_bytes: int
    iterations_mean: float
    ms_per_frame: float
    region_fitted: MapScores | None = None

    def as_json(self) -> dict[str, object]:
        """Return the result as JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> TrialResult:
        """Return the result of as_json's values. Raises InvalidInputError for other content."""
        try:
            scores = {name: _stored_scores(stored[name]) for name in ("scores", "fitted", "region_fitted")}
            return cls(**{**stored, **scores})
        except (TypeError, KeyError) as error:
            raise InvalidInputError(f"cached trial: expected the fields of a result, got {error}") from None


def _stored_scores(stored: dict[str, Any] | None) -> MapScores | None:
    return None if stored is None else MapScores(**stored)


ViewImages = dict[int, UInt8[ndarray, "h w 3"]]
"""Renderings of a map by the position of the held-out view."""


@dataclass(frozen=True, slots=True, eq=False)
class TrialMap:
    """A trial's map at the end of its mission. ms_per_frame: perception and mapping."""

    gaussians: Gaussians
    map_bytes: int
    iterations_mean: float
    ms_per_frame: float


def message_bytes(gaussians: Gaussians, grid: VoxelGrid) -> int:
    """Return the size of these Gaussians in an agent's messages."""
    parts = split_batch(group_by_voxel(gaussians, grid))
    return sum(len(encode_subset(RoiSubset("agent", "", 1, 1, part), grid)) for part in parts)


def build_map(trial: Trial, scene: Scene, on_frame: Callable[[int], None]) -> TrialMap:
    """Return the map of the scene; on_frame gets the number of Gaussians after each frame. Raises GaussLiteError."""
    settings = trial.mission
    estimator = _build_estimator(trial, scene)
    loop = TaskMapper(
        estimator,
        build_mapper(settings),
        scheduler=FrameScheduler(settings.scheduler_settings, clock_for(settings.threads)),
    )
    outcomes: list[FrameOutcome] = []

    def record(outcome: FrameOutcome) -> None:
        outcomes.append(outcome)
        on_frame(outcome.gaussians)

    MissionRunner(loop.process, record).run(scene.training).raise_if_stopped()
    gaussians = loop.gaussians()
    return TrialMap(
        gaussians=gaussians,
        map_bytes=message_bytes(gaussians, VoxelGrid()),
        iterations_mean=fmean(outcome.iterations for outcome in outcomes),
        ms_per_frame=1e3 * fmean(outcome.timing.seconds for outcome in outcomes),
    )


def evaluate_map(
    trial_map: TrialMap, trial: Trial, scene: Scene, lpips: Lpips | None
) -> tuple[TrialResult, ViewImages]:
    """Return the map's scores on the held-out views, and its renderings for the sheets. Raises GaussLiteError."""
    viewer = MapViewer(trial_map.gaussians, choose_rasterizer(threads=trial.conditions.threads))
    shown = largest_roi_views(scene.held_out, SHEET_VIEWS)
    scores, fitted, region_fitted, images = [], [], [], {}
    for i, view in enumerate(scene.held_out):
        rendering = viewer.render_frame(view.frame)
        scores.append(score_view(rendering, view, lpips))
        if trial.plan.pose_policy.fit_views:
            fitted.append(score_view(render_fitted(viewer, view.frame), view, lpips))
            if view.shows_region:
                region_fitted.append(score_view(render_fitted_at_region(viewer, view), view, lpips))
        if i in shown:
            images[i] = to_uint8(rendering.rgb)
    result = TrialResult(
        scores=average(scores),
        fitted=average(fitted) if fitted else None,
        roi_share=scene.roi_share,
        gaussians=len(trial_map.gaussians),
        map_bytes=trial_map.map_bytes,
        iterations_mean=trial_map.iterations_mean,
        ms_per_frame=trial_map.ms_per_frame,
        region_fitted=average(region_fitted) if region_fitted else None,
    )
    return result, images


def clock_for(threads: int | None) -> Clock:
    """Return the clock for frame times: CPU time with one thread, as other programs affect it less."""
    return time.process_time if threads == 1 else time.perf_counter


def _build_estimator(trial: Trial, scene: Scene) -> RelevanceEstimator:
    """Return the trial's estimator; without task if the policy ignores it, as ROI flags would affect eviction."""
    if not trial.follows_task:
        return NoTaskEstimator()
    if not trial.conditions.perception.from_text:
        return RecordedRelevanceEstimator(scene)
    from gausslite_language.rules import RuleParser

    return EstimatorFactory(trial.conditions.perception.detector, lambda: scene.info).build(
        RuleParser().parse(scene.task)
    )
