"""`gausslite bench quality` and `bench ablation`: quality of maps on held-out views at an equal budget."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.config.plain_values import split_names
from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.policies import POLICIES
from gausslite.mission.settings import PerceptionSettings
from gausslite_bench.cli.argument_types import read_image_size
from gausslite_bench.cli.study_options import add_study_options, scene_plans
from gausslite_bench.cli.study_progress import RATE_FILE, run_with_progress, write_results
from gausslite_bench.quality.ablation import cumulative_variants
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.tables import ablation_table, quality_table
from gausslite_bench.quality.trials import BudgetMode, Conditions, PerceptionMode, TrialBudget, Variant

_ABLATION_TASK = "home-4-manipulation"
_BOTH = "both"


def configure_quality(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench quality`."""
    add = parser.add_argument
    add(
        "--pairs",
        metavar="A,B",
        type=split_names,
        default=(),
        help="homes or home-task pairs such as home-3,home-4-search (default: all 24 pairs)",
    )
    add(
        "--policies",
        metavar="A,B",
        type=split_names,
        default=tuple(POLICIES),
        help="policies; tables compare the first with the best other (default: all)",
    )
    add_study_options(parser, default_seeds=(0,))
    _add_size_and_budget(parser, default_equal=str(BudgetMode.ITERATIONS))
    add(
        "--perception",
        metavar="gt|text|FILE.onnx",
        default="gt",
        help="region of the task: ground-truth masks (gt), ground-truth objects named in the task (text), or a "
        "detector model (default: %(default)s)",
    )
    parser.set_defaults(run=run_quality)


def configure_ablation(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench ablation`."""
    parser.add_argument(
        "--pair",
        metavar="A,B",
        type=split_names,
        default=(),
        help=f"homes or home-task pairs (default: {_ABLATION_TASK}, or none with --real)",
    )
    add_study_options(parser, default_seeds=(0, 1, 2))
    _add_size_and_budget(parser, default_equal=_BOTH)
    parser.set_defaults(run=run_ablation)


def run_quality(options: argparse.Namespace) -> int:
    """Compare policies and write quality.md, quality.json and comparison sheets."""
    variants = [Variant(name, name) for name in options.policies]
    if not variants:
        raise InvalidInputError(f"policies: expected names among {', '.join(POLICIES)}, got none")
    plans, default_size = scene_plans(options, options.pairs, ())
    conditions = Conditions(options.size or default_size, _perception_mode(options), options.threads)
    study = Study(plans, variants, _budgets(options), options.seeds, conditions)
    results = run_with_progress(study, options.out, options.lpips_weights, options.reuse_other_code)
    write_results(options.out, "quality", quality_table(results), results)
    return 0


def run_ablation(options: argparse.Namespace) -> int:
    """Enable the components one by one and write ablation.md and ablation.json."""
    plans, default_size = scene_plans(options, options.pair, (_ABLATION_TASK,))
    conditions = Conditions(options.size or default_size, PerceptionMode(), options.threads)
    study = Study(plans, cumulative_variants(), _budgets(options), options.seeds, conditions)
    results = run_with_progress(study, options.out, options.lpips_weights, options.reuse_other_code)
    write_results(options.out, "ablation", ablation_table(results), results)
    return 0


def _add_size_and_budget(parser: argparse.ArgumentParser, default_equal: str) -> None:
    parser.add_argument(
        "--size",
        metavar="WxH",
        type=read_image_size,
        help="image size (default: 320x240; real sequences keep their aspect ratio)",
    )
    add, budget = parser.add_argument_group("budget").add_argument, TrialBudget()
    add(
        "--equal",
        choices=[*(str(mode) for mode in BudgetMode), _BOTH],
        default=default_equal,
        help="quantity per frame that is equal for all policies (default: %(default)s)",
    )
    add("--max-gaussians", metavar="N", type=int, default=budget.max_gaussians, help="hard cap (default: %(default)s)")
    add(
        "--iterations",
        metavar="N",
        type=int,
        default=budget.iterations,
        help="iterations per frame at equal iterations (default: %(default)s)",
    )
    add(
        "--rate",
        metavar="HZ",
        type=float,
        help="frame rate at equal time (default: the rate of uniform mapping with --iterations, measured on the first "
        f"scene and stored in DIR/{RATE_FILE})",
    )


def _budgets(options: argparse.Namespace) -> list[TrialBudget]:
    modes = list(BudgetMode) if options.equal == _BOTH else [BudgetMode(options.equal)]
    return [TrialBudget(options.max_gaussians, mode, options.iterations, options.rate) for mode in modes]


def _perception_mode(options: argparse.Namespace) -> PerceptionMode:
    if options.perception == "gt":
        return PerceptionMode()
    if options.perception == "text":
        return PerceptionMode(from_text=True)
    detector = PerceptionSettings(Path(options.perception), threads=options.threads)
    return PerceptionMode(from_text=True, detector=detector)
