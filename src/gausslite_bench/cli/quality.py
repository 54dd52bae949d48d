"""`gausslite bench quality` and `bench ablation`: quality of maps on held-out views at an equal budget."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.option import build, option, options_of
from gausslite.config.plain_values import require_plain
from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.policies import POLICIES, TASK, UNIFORM
from gausslite.mission.settings import MAX_RATE_HZ, MIN_RATE_HZ
from gausslite_bench.cli.study_options import (
    DEFAULT_HOME_FRAMES,
    DEFAULT_SIZE,
    StudyOptions,
    one_or_more,
    real_sequence_plans,
    study_command,
    write_results,
)
from gausslite_bench.quality.growth import curves, growth_plot, growth_table
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import choose_home_tasks
from gausslite_bench.quality.scenes import UnseenRegionError
from gausslite_bench.quality.study import FinishedTrial, Study, run_study, with_measured_rate
from gausslite_bench.quality.tables import StudyResults, ablation_table, quality_table
from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_bench.quality.trials import BudgetMode, Conditions, ScenePlan, TrialBudget, Variant, cumulative_variants
from gausslite_evaluation.lpips import LPIPS_HELP, load_lpips

_ABLATION_TASK = "home-4-manipulation"
_BOTH = "both"
_EQUAL_HELP = "quantity per frame that is equal for all policies"
_EQUAL = (*map(str, BudgetMode), _BOTH)
_PAIR_HELP = "homes or home-task pairs such as home-3,home-4-search"


@dataclass(frozen=True, slots=True)
class _BudgetOptions:
    views: int = option(24, "held-out views per home", low=2)
    rate_hz: float | None = option(
        None,
        "frame rate at equal time (default: that of uniform mapping with --iterations, measured on the first scene)",
        key="rate",
        metavar="HZ",
        low=MIN_RATE_HZ,
        high=MAX_RATE_HZ,
    )
    lpips_weights: Path | None = option(None, LPIPS_HELP)


@dataclass(frozen=True, slots=True)
class _QualityOptions:
    pairs: tuple[str, ...] = option((), f"{_PAIR_HELP} (default: all 24 pairs)", metavar="A,B")
    policies: tuple[str, ...] = option(
        tuple(POLICIES), "policies; margins are of the first (default: all)", metavar="A,B", convert=one_or_more()
    )
    seeds: tuple[int, ...] = option((0,), "mapping seeds", metavar="N,...", convert=one_or_more())
    equal: str = option(str(BudgetMode.ITERATIONS), _EQUAL_HELP, choices=_EQUAL)


@dataclass(frozen=True, slots=True)
class _AblationOptions:
    pair: tuple[str, ...] = option((), f"{_PAIR_HELP} (default: {_ABLATION_TASK}, or none with --real)", metavar="A,B")
    seeds: tuple[int, ...] = option((0, 1, 2), "mapping seeds", metavar="N,...", convert=one_or_more())
    equal: str = option(_BOTH, _EQUAL_HELP, choices=_EQUAL)


_FRAMES, _RATE = "frames", "rate"
_GROWTH_STEPS = {
    "iterations": ("4", "8", "16", "32", "64", "128"),
    _RATE: ("8", "4", "2", "1"),
    _FRAMES: ("15", "30", "60", "120"),
    "max-gaussians": ("10000", "30000", "100000", "300000"),
}
"""The quantities that may grow, and the default steps; a lower rate gives a frame more time."""


@dataclass(frozen=True, slots=True)
class _GrowthOptions:
    quantity: str = option("iterations", "what grows; the other limits stay", choices=tuple(_GROWTH_STEPS))
    steps: tuple[str, ...] = option((), "its values from the least to the most", metavar="N,...", convert=one_or_more())
    pairs: tuple[str, ...] = option((), f"{_PAIR_HELP} (default: {_ABLATION_TASK}, or none with --real)", metavar="A,B")
    policies: tuple[str, ...] = option((TASK, UNIFORM), "policies", metavar="A,B", convert=one_or_more())
    seeds: tuple[int, ...] = option((0,), "mapping seeds", metavar="N,...", convert=one_or_more())
    views: int = option(24, "held-out views per home", low=2)


def run_quality(options: argparse.Namespace) -> int:
    """Compare policies and write quality.md and quality.json."""
    variants = [Variant(name, name) for name in options.policies]
    return _report(options, _study(options, options.pairs, (), variants), "quality", quality_table)


def run_ablation(options: argparse.Namespace) -> int:
    """Enable the components one by one and write ablation.md and ablation.json."""
    study = _study(options, options.pair, (_ABLATION_TASK,), cumulative_variants())
    return _report(options, study, "ablation", ablation_table)


def run_compute(options: argparse.Namespace) -> int:
    """Let one quantity grow, and write compute.md, compute.svg and compute.json; 1 if a curve falls."""
    chosen = build(_GrowthOptions, options)
    steps = chosen.steps or _GROWTH_STEPS[chosen.quantity]
    variants = [Variant(name, name) for name in chosen.policies]
    # wrong values fail here, before hours of work
    stepped = {step: _with_step(options, chosen.quantity, step) for step in steps}
    values = [getattr(own, chosen.quantity.replace("-", "_")) for own in stepped.values()]
    if values != sorted(set(values), reverse=chosen.quantity == _RATE):
        raise InvalidInputError(f"steps: expected ascending values, descending rates, got {', '.join(steps)}")
    studies = {step: _study(own, chosen.pairs, (_ABLATION_TASK,), variants) for step, own in stepped.items()}
    budgets = [study.budgets[0] for study in studies.values()]
    if chosen.quantity == _FRAMES:
        results = [_run(stepped[step], study) for step, study in studies.items()]
    else:  # one study of several budgets, which makes a scene's images once
        results = [_run(stepped[steps[0]], replace(studies[steps[0]], budgets=budgets))] * len(steps)
    found = curves(list(zip(results, budgets, strict=True)))
    table = growth_table(chosen.quantity, steps, found)
    trials = [trial for one in dict.fromkeys(results) for trial in one.trials_as_json()]
    write_results(options.out, "compute", table, trials)
    write_atomic(options.out / "compute.svg", growth_plot(steps, found).encode())
    print(f"{table}→ {options.out / 'compute.md'}, compute.svg")
    return int(any(curve.falls for curve in found))


def _with_step(options: argparse.Namespace, quantity: str, step: str) -> argparse.Namespace:
    """Return the options with another value of the quantity. Raises InvalidInputError."""
    try:
        value = float(step) if quantity == _RATE else int(step)
    except ValueError:
        raise InvalidInputError(f"steps: expected numbers such as {_GROWTH_STEPS[quantity][0]}, got {step!r}") from None
    limits = options_of(_BudgetOptions if quantity == _RATE else StudyOptions)[quantity].option
    require_plain("steps", value, type(value), limits.low, limits.high, unit="", choices=())
    name = quantity.replace("-", "_")
    equal = BudgetMode.TIME if quantity == _RATE else BudgetMode.ITERATIONS
    others = {"rate": None, "lpips_weights": None, "equal": str(equal)}
    return argparse.Namespace(**{**vars(options), **others, name: value})


def _study(
    options: argparse.Namespace,
    pairs: Sequence[str],
    default_pairs: Sequence[str],
    variants: Sequence[Variant],
) -> Study:
    """Return the study; wrong names, numbers and files fail here, before hours of work. Raises GaussLiteError.

    default_pairs replaces an empty list if there is no real sequence.
    """
    chosen, budget = build(StudyOptions, options), build(_BudgetOptions, options)
    real = real_sequence_plans(options, chosen.frames)
    plans, size = ([], DEFAULT_SIZE) if real is None else real
    scenes: list[ScenePlan] = list(plans)
    if real is None or pairs:
        frames = DEFAULT_HOME_FRAMES if chosen.frames is None else chosen.frames
        tasks = choose_home_tasks(pairs or default_pairs)
        scenes[:0] = [HomeScenePlan(task, frames, budget.views) for task in tasks]
    modes = list(BudgetMode) if options.equal == _BOTH else [BudgetMode(options.equal)]
    budgets = [TrialBudget(chosen.max_gaussians, equal, chosen.iterations, budget.rate_hz) for equal in modes]
    conditions = Conditions(chosen.size or size, chosen.threads)
    study = Study(scenes, variants, budgets, options.seeds, conditions)
    for plan in scenes:
        for trial in study.trials(plan):
            _ = trial.mission
    return study


def _run(options: argparse.Namespace, study: Study) -> StudyResults:
    """Return the results of the study; finished trials are cached in the folder. Raises GaussLiteError."""
    lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights, options.threads)
    cache = TrialCache(options.out)
    study = with_measured_rate(study, cache)
    finished: list[FinishedTrial] = []
    unseen: list[UnseenRegionError] = []
    with progress_bar(sum(len(study.trials(plan)) for plan in study.plans), "trials", "trial") as bar:
        for outcome in run_study(study, cache, lpips):
            if isinstance(outcome, UnseenRegionError):
                unseen.append(outcome)
                print_above_bar(f"skipped: {outcome}")
                continue
            finished.append(outcome)
            print_above_bar(_line(outcome))
            bar.update()
    if not finished:
        raise unseen[0]
    return StudyResults(finished)


def _line(finished: FinishedTrial) -> str:
    trial, scores = finished.trial, finished.result.scores
    roi = "no view shows the region" if scores.roi_psnr is None else f"ROI {scores.roi_psnr:.2f} dB"
    origin = " (cached)" if finished.is_cached else ""
    name = f"{trial.plan.name} {trial.variant.label} equal {trial.budget.equal} ({trial.budget}) seed {trial.seed}"
    return f"{name}: {roi}, full {scores.full_psnr:.2f} dB{origin}"


def _report(options: argparse.Namespace, study: Study, name: str, table_of: Callable[[StudyResults], str]) -> int:
    results = _run(options, study)
    table = table_of(results)
    write_results(options.out, name, table, results.trials_as_json())
    print(f"{table}→ {options.out / f'{name}.md'}")
    return 0


configure_quality = study_command(run_quality, _QualityOptions, _BudgetOptions)
configure_ablation = study_command(run_ablation, _AblationOptions, _BudgetOptions)
configure_compute = study_command(run_compute, _GrowthOptions)
