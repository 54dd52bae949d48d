"""Run the trials of a study; finished trials are loaded from the cache."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Protocol, runtime_checkable

from gausslite_bench.quality.scenes import Scene, ScenePlan, UnseenRegionError
from gausslite_bench.quality.trial_cache import CachedTrial, TrialCache
from gausslite_bench.quality.trials import (
    Conditions,
    Trial,
    TrialBudget,
    TrialMap,
    TrialResult,
    Variant,
    build_map,
    evaluate_map,
)
from gausslite_evaluation.lpips import Lpips


class Origin(StrEnum):
    """Origin of a trial's result: computed, or read from the cache."""

    COMPUTED = "computed"
    RECOMPUTED = "computed again, as the cached result is from other code"
    CACHED = "cached"
    CACHED_OTHER_CODE = "cached, from other code"


@runtime_checkable
class StudyObserver(Protocol):
    """Callbacks for the progress of a study."""

    def on_frame(self, gaussians: int) -> None:
        """Handle a mapped frame."""
        ...

    def on_finished(self, trial: FinishedTrial) -> None:
        """Handle a trial's result."""
        ...

    def on_skipped(self, trials: int, reason: UnseenRegionError) -> None:
        """Handle the skipped trials of a scene whose region is in no held-out view."""
        ...


@dataclass(frozen=True, slots=True)
class Study:
    """The product of scenes, variants, seeds and budgets."""

    plans: Sequence[ScenePlan]
    variants: Sequence[Variant]
    budgets: Sequence[TrialBudget]
    seeds: Sequence[int]
    conditions: Conditions

    def trials(self, plan: ScenePlan) -> list[Trial]:
        """Return the trials on one scene; the variants of one seed are consecutive."""
        return [
            Trial(plan, variant, budget, seed, self.conditions)
            for budget in self.budgets
            for seed in self.seeds
            for variant in self.variants
        ]

    def with_rate(self, rate_hz: float) -> Study:
        """Return the study with this rate in every budget that needs one."""
        budgets = [replace(budget, rate_hz=rate_hz) if budget.needs_rate else budget for budget in self.budgets]
        return replace(self, budgets=budgets)

    @property
    def count(self) -> int:
        """Number of trials."""
        return len(self.plans) * len(self.budgets) * len(self.seeds) * len(self.variants)


@dataclass(frozen=True, slots=True, eq=False)
class FinishedTrial:
    """A trial with its result."""

    trial: Trial
    result: TrialResult
    origin: Origin

    @property
    def from_other_code(self) -> bool:
        """True if code with another hash computed the result."""
        return self.origin is Origin.CACHED_OTHER_CODE


class _MapCache:
    """Maps that do not depend on the task, reused for the other tasks on the same training frames."""

    def __init__(self) -> None:
        self._training_settings: Mapping[str, object] = {}
        self._maps: dict[str, TrialMap] = {}

    def enter_scene(self, plan: ScenePlan) -> None:
        """Drop the maps of other training frames."""
        if plan.training_settings() != self._training_settings:
            self._training_settings, self._maps = plan.training_settings(), {}

    def get_or_build(self, trial: Trial, scene: Scene, observer: StudyObserver) -> TrialMap:
        """Return the trial's map and build it if it is not cached. Raises GaussLiteError."""
        trial_map = self._maps.get(trial.map_key)
        if trial_map is None:
            trial_map = build_map(trial, scene, observer.on_frame)
        if not trial.follows_task:
            self._maps[trial.map_key] = trial_map
        return trial_map


def run_study(
    study: Study,
    cache: TrialCache,
    lpips: Lpips | None,
    observer: StudyObserver,
    reuse_other_code: bool = False,
) -> list[FinishedTrial]:
    """Return all results; compute those not in the cache. A scene's frames are loaded only if a trial needs them.

    Results from other code are computed again unless reuse_other_code is set. Scenes whose region is in no held-out
    view are skipped. Raises UnseenRegionError if that skips all scenes.
    """
    finished: list[FinishedTrial] = []
    maps = _MapCache()
    unseen: UnseenRegionError | None = None
    for plan in study.plans:
        maps.enter_scene(plan)
        trials = study.trials(plan)
        cached_trials = [_look_up(trial, cache, lpips is not None, reuse_other_code) for trial in trials]
        scene: Scene | None = None
        if any(cached is None for cached, _ in cached_trials):
            try:
                scene = plan.load(study.conditions.size)
            except UnseenRegionError as error:
                unseen = error
                observer.on_skipped(len(trials), error)
                continue
        for trial, (cached, origin) in zip(trials, cached_trials, strict=True):
            if cached is not None:
                result = cached.result
            else:
                assert scene is not None
                trial_map = maps.get_or_build(trial, scene, observer)
                result, images = evaluate_map(trial_map, trial, scene, lpips)
                cache.store_trial(trial, result, images)
            finished.append(FinishedTrial(trial, result, origin))
            observer.on_finished(finished[-1])
        if scene is not None:
            cache.write_sheets(trials[: len(study.variants)], scene)
    if unseen is not None and not finished:
        raise unseen
    return finished


def expected_origins(study: Study, cache: TrialCache, with_lpips: bool, reuse_other_code: bool) -> Counter[Origin]:
    """Count the trials that run_study would compute and those it would load from the cache."""
    trials = (trial for plan in study.plans for trial in study.trials(plan))
    return Counter(_look_up(trial, cache, with_lpips, reuse_other_code)[1] for trial in trials)


def _look_up(
    trial: Trial, cache: TrialCache, with_lpips: bool, reuse_other_code: bool
) -> tuple[CachedTrial | None, Origin]:
    cached = cache.load_trial(trial, with_lpips)
    if cached is None:
        return None, Origin.COMPUTED
    if cached.code == cache.code:
        return cached, Origin.CACHED
    return (cached, Origin.CACHED_OTHER_CODE) if reuse_other_code else (None, Origin.RECOMPUTED)
