"""A small scene of the quality benchmark, two policies, and results without their hours of work."""

from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import choose_home_tasks
from gausslite_bench.quality.study import FinishedTrial
from gausslite_bench.quality.trials import Conditions, MapCost, Trial, TrialBudget, TrialResult, Variant
from gausslite_evaluation.compare import MapScores

PLAN = HomeScenePlan(choose_home_tasks(["home-8-manipulation"])[0], frames=4, views=3)
CONDITIONS = Conditions((96, 72))
TASK, UNIFORM = Variant("task", "task"), Variant("uniform", "uniform")


def scores(roi_psnr: float | None, full_psnr: float = 20.0) -> MapScores:
    return MapScores(roi_psnr, 0.8, full_psnr, 0.7, 0.02, 0.938, 3, 2, 900, 0.03)


def finished(
    variant: Variant, seed: int, roi_psnr: float, budget: TrialBudget, plan: HomeScenePlan = PLAN
) -> FinishedTrial:
    trial = Trial(plan, variant, budget, seed, CONDITIONS)
    result = TrialResult(scores(roi_psnr), 0.011, MapCost(900, 8100, 8.0, 12.5))
    return FinishedTrial(trial, result)
