"""Frame rate for studies at equal time: the rate of uniform mapping with the budget's iterations on this machine.

Results at a fixed rate depend on the machine's speed. A study therefore measures the rate once, on its first scene,
and stores it in its folder.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import write_json
from gausslite.mission.settings import MAX_RATE_HZ, MIN_RATE_HZ
from gausslite_bench.quality.scenes import Scene, UnseenRegionError
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import BudgetMode, Trial, TrialBudget, Variant, build_map

_UNIFORM = Variant("uniform", "uniform")
_DIGITS = 3


def rate_trials(study: Study) -> list[Trial]:
    """Return uniform mapping of each scene, candidates for measuring the rate; empty if no budget needs a rate."""
    timed = [budget for budget in study.budgets if budget.needs_rate]
    if not timed:
        return []
    budget = TrialBudget(timed[0].max_gaussians, BudgetMode.ITERATIONS, timed[0].iterations)
    return [Trial(plan, _UNIFORM, budget, study.seeds[0], study.conditions) for plan in study.plans]


def first_visible_scene(trials: Sequence[Trial]) -> tuple[Trial, Scene]:
    """Return the first trial whose region is in a held-out view, and its scene. Raises UnseenRegionError."""
    for trial in trials[:-1]:
        with contextlib.suppress(UnseenRegionError):
            return trial, trial.plan.load(trial.conditions.size)
    return trials[-1], trials[-1].plan.load(trials[-1].conditions.size)


def load_rate(path: Path, trials: Sequence[Trial]) -> float | None:
    """Return the stored rate in Hz if one of these trials measured it, else None. Raises InvalidInputError."""
    try:
        record = json.loads(path.read_text())
        rate_hz = float(record["rate_hz"]) if record["trial"] in {trial.key for trial in trials} else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if rate_hz is not None and not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise InvalidInputError(f"rate: expected {MIN_RATE_HZ} to {MAX_RATE_HZ:g} Hz, got {rate_hz}")
    return rate_hz


def measure_rate(path: Path, trial: Trial, scene: Scene, on_frame: Callable[[int], None]) -> float:
    """Return the frames per second of this trial and store them for later runs. Raises GaussLiteError."""
    trial_map = build_map(trial, scene, on_frame)
    rate_hz = float(f"{1e3 / trial_map.ms_per_frame:.{_DIGITS}g}")
    write_json(path, {"trial": trial.key, "rate_hz": rate_hz})
    return rate_hz
