"""How much time a frame has at equal time: as much as uniform mapping takes for its iterations, on this machine.

A fixed rate tells little on another machine: with twice the time every policy comes near what the training images can
give, with half of it none does. So a study is paced once, on its first scene, and keeps that pace in its folder.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from gausslite.mission.results import write_json
from gausslite.mission.settings import require_rate
from gausslite_bench.quality.scenes import Scene, UnseenRegionError
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import BudgetMode, Trial, TrialBudget, Variant, build_map

_UNIFORM = Variant("uniform", "uniform")
_DIGITS = 3


def pacing_trials(study: Study) -> list[Trial]:
    """Uniform mapping of each scene, the first of which paces the study; none where no budget waits for a rate."""
    waiting = [budget for budget in study.budgets if budget.awaits_rate]
    if not waiting:
        return []
    budget = TrialBudget(waiting[0].max_gaussians, BudgetMode.ITERATIONS, waiting[0].iterations)
    return [Trial(plan, _UNIFORM, budget, study.seeds[0], study.conditions) for plan in study.plans]


def first_scene(trials: Sequence[Trial]) -> tuple[Trial, Scene]:
    """The first of these whose region some held-out view shows. Raises UnseenRegionError where there is none."""
    for trial in trials[:-1]:
        with contextlib.suppress(UnseenRegionError):
            return trial, trial.plan.load(trial.conditions.size)
    return trials[-1], trials[-1].plan.load(trials[-1].conditions.size)


def kept_rate(path: Path, trials: Sequence[Trial]) -> float | None:
    """The rate in Hz that was measured by one of these before; None where none is kept. Raises InvalidInputError."""
    try:
        kept = json.loads(path.read_text())
        rate_hz = float(kept["rate_hz"]) if kept["trial"] in {trial.key for trial in trials} else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if rate_hz is not None:
        require_rate(rate_hz)
    return rate_hz


def measure_rate(path: Path, trial: Trial, scene: Scene, on_frame: Callable[[int], None]) -> float:
    """How many frames a second this trial maps, kept at the path for later runs. Raises GaussLiteError."""
    made = build_map(trial, scene, on_frame)
    rate_hz = float(f"{1e3 / made.ms_per_frame:.{_DIGITS}g}")
    write_json(path, {"trial": trial.key, "rate_hz": rate_hz})
    return rate_hz
