"""One trial: one policy maps one scene from one seed within the budget, and is scored on the held-out views."""

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

from gausslite.domain.gaussians import Gaussians
from gausslite.errors import InvalidInputError
from gausslite.evaluation.compare import MapScores, PerceptualDistance, average, score_view
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.pictures import to_uint8
from gausslite.evaluation.views import MapViewer, largest_roi_views
from gausslite.mapping.policies import TASK
from gausslite.mission.build import build_estimator, build_mapper
from gausslite.mission.frame_scheduler import Clock, FrameScheduler
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.fixed_relevance import NoTaskEstimator
from gausslite.perception.relevance_estimator import RelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene, ScenePlan

PICTURES = 2


class BudgetMode(StrEnum):
    """What all policies get the same of, a frame."""

    ITERATIONS = "iterations"
    TIME = "time"


@dataclass(frozen=True, slots=True)
class TrialBudget:
    """What every policy may spend: Gaussians in all, and iterations or 1 / rate_hz seconds a frame.

    rate_hz None: a rate is still to be measured (`pacing`), where it is time that is equal.
    """

    max_gaussians: int = 60_000
    equal: BudgetMode = BudgetMode.ITERATIONS
    iterations: int = 8
    rate_hz: float | None = None

    @property
    def awaits_rate(self) -> bool:
        """True where time is equal and nobody has said yet how much there is."""
        return self.equal is BudgetMode.TIME and self.rate_hz is None

    def __str__(self) -> str:
        """What a frame gets of what is equal."""
        if self.equal is BudgetMode.ITERATIONS:
            return f"{self.iterations} iterations a frame"
        return "time" if self.rate_hz is None else f"{1e3 / self.rate_hz:.3g} ms a frame"


@dataclass(frozen=True, slots=True)
class Variant:
    """A policy with components switched off; label names it in tables."""

    label: str
    policy: str
    without: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class PerceptionMode:
    """How the task's region is found: by ground-truth masks, or by the task's words and a detector.

    detector None with words means the words are looked up among the scene's ground-truth objects.
    """

    words: bool = False
    detector: PerceptionSettings = field(default_factory=PerceptionSettings)


@dataclass(frozen=True, slots=True)
class Conditions:
    """What is the same for every trial of a study."""

    size: tuple[int, int]
    eyes: PerceptionMode = field(default_factory=PerceptionMode)
    threads: int | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """Everything that decides a result."""

    plan: ScenePlan
    variant: Variant
    budget: TrialBudget
    seed: int
    conditions: Conditions

    @property
    def mission(self) -> MissionSettings:
        """How the robot maps. Raises InvalidInputError for an unknown policy or component."""
        timed = self.budget.equal is BudgetMode.TIME
        return MissionSettings(
            policy=self.variant.policy,
            disabled=self.variant.without,
            max_gaussians=self.budget.max_gaussians,
            iterations=None if timed else self.budget.iterations,
            rate_hz=self.budget.rate_hz if timed else None,
            seed=self.seed,
            threads=self.conditions.threads,
            pose_prior=self.plan.trust.pose_prior,
        )

    @property
    def follows_task(self) -> bool:
        """False where nothing in the policy asks for the task's region: its map is the same for every task."""
        return self.variant.policy == TASK and self.mission.mapper_settings().components.follow_task

    @property
    def key(self) -> str:
        """A name that changes with every setting, down to the policy's own."""
        digest = self._digest(self.plan.settings())
        return f"{self.plan.name}-{self.variant.label}-{self.budget.equal}-{self.seed}-{digest}".replace("+", "with-")

    @property
    def map_key(self) -> str:
        """A name that changes with all that the map depends on, the task among it only where it is followed."""
        return self._digest(self.plan.settings() if self.follows_task else self.plan.place())

    def _digest(self, scene: Mapping[str, object]) -> str:
        # the mapper's settings tell what is switched off; a set of names has another order in every process
        settings = {
            "scene": dict(scene),
            "mission": str(replace(self.mission, disabled=frozenset())),
            "mapper": str(self.mission.mapper_settings()),
            "conditions": str(self.conditions),
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What a trial gave; roi_share is that of the held-out views. ms_per_frame counts perception and mapping.

    fitted are the scores with each view's pose and colours fitted, None where that was not asked for.
    """

    scores: MapScores
    fitted: MapScores | None
    roi_share: float
    gaussians: int
    iterations_mean: float
    ms_per_frame: float

    def as_json(self) -> dict[str, object]:
        """For the record."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> TrialResult:
        """From as_json's. Raises InvalidInputError for anything else."""
        try:
            fitted = None if stored["fitted"] is None else MapScores(**stored["fitted"])
            return cls(**{**stored, "scores": MapScores(**stored["scores"]), "fitted": fitted})
        except (TypeError, KeyError) as error:
            raise InvalidInputError(f"a kept trial: expected its figures, got {error}") from None


Pictures = dict[int, UInt8[ndarray, "h w 3"]]
"""What a map looks like from the most telling held-out views, by their position."""


@dataclass(frozen=True, slots=True, eq=False)
class TrialMap:
    """A trial's map at the end of its mission. ms_per_frame counts perception and mapping."""

    gaussians: Gaussians
    iterations_mean: float
    ms_per_frame: float


def build_map(trial: Trial, scene: Scene, on_frame: Callable[[int], None]) -> TrialMap:
    """Map the scene; on_frame hears the number of Gaussians after each frame. Raises GaussLiteError."""
    settings = trial.mission
    attention = _attention(trial, scene)
    loop = TaskMapper(
        attention,
        build_mapper(settings),
        scheduler=FrameScheduler(settings.scheduler_settings, clock_for(settings.threads)),
    )
    outcomes = []
    for frame in scene.training:
        outcomes.append(loop.process(frame))
        on_frame(outcomes[-1].gaussians)
    return TrialMap(
        gaussians=loop.gaussians(),
        iterations_mean=fmean(outcome.iterations for outcome in outcomes),
        ms_per_frame=1e3 * fmean(outcome.timing.seconds for outcome in outcomes),
    )


def evaluate_map(
    made: TrialMap, trial: Trial, scene: Scene, perceptual: PerceptualDistance | None
) -> tuple[TrialResult, Pictures]:
    """Score a map on the scene's held-out views, and draw those that tell most. Raises GaussLiteError."""
    viewer = MapViewer(made.gaussians, choose_rasterizer(threads=trial.conditions.threads))
    shown = largest_roi_views(scene.held_out, PICTURES)
    scores, fitted, pictures = [], [], {}
    for i, view in enumerate(scene.held_out):
        drawn = viewer.render_frame(view.frame)
        scores.append(score_view(drawn, view, perceptual))
        if trial.plan.trust.fit_views:
            fitted.append(score_view(render_fitted(viewer, view.frame), view, perceptual))
        if i in shown:
            pictures[i] = to_uint8(drawn.rgb)
    result = TrialResult(
        scores=average(scores),
        fitted=average(fitted) if fitted else None,
        roi_share=scene.roi_share,
        gaussians=len(made.gaussians),
        iterations_mean=made.iterations_mean,
        ms_per_frame=made.ms_per_frame,
    )
    return result, pictures


def clock_for(threads: int | None) -> Clock:
    """What measures a frame: with a single thread the processor's own time, which other programs disturb less."""
    return time.process_time if threads == 1 else time.perf_counter


def _attention(trial: Trial, scene: Scene) -> RelevanceEstimator:
    """What does not follow the task is not told of it: marked Gaussians would be spared when room is short."""
    if not trial.follows_task:
        return NoTaskEstimator()
    if not trial.conditions.eyes.words:
        return RecordedRelevanceEstimator(scene)
    from gausslite.task.rules import RuleParser

    return build_estimator(RuleParser().parse(scene.task), scene.knowledge, trial.conditions.eyes.detector)
