"""Run the trials of a study: every scene, variant, seed and budget; finished trials are loaded from the cache."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.policies import UNIFORM
from gausslite_bench.quality.scenes import Scene, UnseenRegionError
from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_bench.quality.trials import (
    BudgetMode,
    Conditions,
    MapCost,
    ScenePlan,
    Trial,
    TrialBudget,
    TrialResult,
    Variant,
    build_map,
    evaluate_map,
)
from gausslite_evaluation.lpips import Lpips


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


@dataclass(frozen=True, slots=True, eq=False)
class FinishedTrial:
    """A trial with its result."""

    trial: Trial
    result: TrialResult
    is_cached: bool = False


def run_study(study: Study, cache: TrialCache, lpips: Lpips | None) -> Iterator[FinishedTrial | UnseenRegionError]:
    """Yield each result, or why a scene is skipped: its region is in no held-out view. Raises GaussLiteError.

    A scene's frames are loaded only if a trial needs them; a map that does not depend on the task is shared by the
    tasks on the same training frames.
    """
    training: Mapping[str, object] = {}
    maps: dict[str, tuple[Gaussians, MapCost]] = {}
    for plan in study.plans:
        if plan.training_settings() != training:
            training, maps = plan.training_settings(), {}
        scene: Scene | None = None
        for trial in study.trials(plan):
            result = cache.load(trial, lpips is not None)
            is_cached = result is not None
            if result is None:
                try:
                    scene = scene or plan.load(study.conditions.size)
                except UnseenRegionError as error:
                    yield error
                    break
                built = maps.get(trial.map_key) or build_map(trial, scene)
                if not trial.follows_task:
                    maps[trial.map_key] = built
                result = evaluate_map(built, trial, scene, lpips)
                cache.store(trial, result)
            yield FinishedTrial(trial, result, is_cached)


def with_measured_rate(study: Study, cache: TrialCache) -> Study:
    """Return the study with a rate in every budget that needs one. Raises GaussLiteError.

    Results at a fixed rate depend on the machine's speed. The rate is therefore that of uniform mapping with the
    budget's iterations, measured by a trial on the first scene, which the cache keeps.
    """
    timed = next((budget for budget in study.budgets if budget.needs_rate), None)
    if timed is None:
        return study
    counted, uniform = replace(timed, equal=BudgetMode.ITERATIONS), Variant(UNIFORM, UNIFORM)
    for outcome in run_study(replace(study, variants=[uniform], budgets=[counted]), cache, None):
        if isinstance(outcome, FinishedTrial):
            rate_hz = float(f"{1e3 / outcome.result.cost.ms_per_frame:.3g}")
            with_rate = [replace(own, rate_hz=rate_hz) if own.needs_rate else own for own in study.budgets]
            return replace(study, budgets=with_rate)
    raise UnseenRegionError("expected a scene whose region is in a held-out view, got none")
