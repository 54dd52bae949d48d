"""Frame rate for studies at equal time: the rate of uniform mapping with the budget's iterations on this machine.

Results at a fixed rate depend on the machine's speed. A study therefore measures the rate once, on its first scene,
and stores it in its folder.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from gausslite.mission.results import write_json
from gausslite.mission.settings import MAX_RATE_HZ, MIN_RATE_HZ
from gausslite_bench.quality.scenes import UnseenRegionError
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import BudgetMode, Trial, TrialBudget, Variant, build_map

RATE_FILE = "rate.json"
_UNIFORM = Variant("uniform", "uniform")


def with_measured_rate(study: Study, folder: Path) -> Study:
    """Return the study with a rate in every budget that needs one, stored or measured. Raises GaussLiteError."""
    timed = [budget for budget in study.budgets if budget.needs_rate]
    if not timed:
        return study
    budget = TrialBudget(timed[0].max_gaussians, BudgetMode.ITERATIONS, timed[0].iterations)
    trials = [Trial(plan, _UNIFORM, budget, study.seeds[0], study.conditions) for plan in study.plans]
    return study.with_rate(stored_rate(folder, trials) or _measure_rate(folder, trials))


def stored_rate(folder: Path, trials: list[Trial]) -> float | None:
    """Return the stored rate in Hz if one of these trials measured it."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        record = json.loads((folder / RATE_FILE).read_text())
        if record["trial"] in {trial.key for trial in trials} and MIN_RATE_HZ <= record["rate_hz"] <= MAX_RATE_HZ:
            return float(record["rate_hz"])
    return None


def _measure_rate(folder: Path, trials: list[Trial]) -> float:
    """Return the frames per second on the first scene whose region is in a held-out view, and store them."""
    for trial in trials:
        with contextlib.suppress(UnseenRegionError):
            _, cost = build_map(trial, trial.plan.load(trial.conditions.size))
            rate_hz = float(f"{1e3 / cost.ms_per_frame:.3g}")
            write_json(folder / RATE_FILE, {"trial": trial.key, "rate_hz": rate_hz})
            return rate_hz
    raise UnseenRegionError("expected a scene whose region is in a held-out view, got none")
