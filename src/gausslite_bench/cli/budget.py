"""`gausslite bench budget`: when the task policy pays, against Gaussians, image size and iterations."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.progress import print_above_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import split_names
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import write_json
from gausslite_bench.cli.argument_types import read_counts, read_image_sizes
from gausslite_bench.cli.study_options import add_study_options, scene_plans
from gausslite_bench.cli.study_progress import run_with_progress
from gausslite_bench.plots import require_matplotlib, write_curves
from gausslite_bench.quality.budget import (
    VARIANTS,
    BudgetAxes,
    BudgetPoint,
    TaskGain,
    budget_curves,
    budget_table,
    task_gain,
)
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import Conditions

_CAPS, _ITERATIONS = (60_000, 30_000, 15_000), (8, 4, 16)
_PAIRS = ("home-3-search", "home-4-manipulation")


def configure_budget(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench budget`."""
    add = parser.add_argument
    add(
        "--pairs",
        metavar="A,B",
        type=split_names,
        default=(),
        help=f"homes or home-task pairs (default: {','.join(_PAIRS)}, or none with --real)",
    )
    add_study_options(parser, default_seeds=(0, 1))
    group = parser.add_argument_group("budgets", "While one varies, the others have their first value.")
    group.add_argument(
        "--caps",
        metavar="N,...",
        type=read_counts,
        default=_CAPS,
        help=f"hard caps on Gaussians (default: {','.join(map(str, _CAPS))})",
    )
    group.add_argument(
        "--sizes",
        metavar="WxH,...",
        type=read_image_sizes,
        help="image sizes (default: 320x240 and twice that; real sequences keep their aspect ratio)",
    )
    group.add_argument(
        "--iterations",
        metavar="N,...",
        type=read_counts,
        default=_ITERATIONS,
        help=f"iterations per frame (default: {','.join(map(str, _ITERATIONS))})",
    )
    parser.set_defaults(run=run_budget)


def run_budget(options: argparse.Namespace) -> int:
    """Compare the task policy with uniform mapping at every budget; rewrite the tables after each one."""
    plans, (width_px, height_px) = scene_plans(options, options.pairs, _PAIRS)
    sizes = options.sizes or ((width_px, height_px), (2 * width_px, 2 * height_px))
    axes = BudgetAxes(options.caps, sizes, options.iterations)
    gains: dict[BudgetPoint, TaskGain] = {}
    for point in axes.all_points():
        conditions = Conditions(point.size, threads=options.threads)
        study = Study(plans, VARIANTS, [point.trial_budget], options.seeds, conditions)
        finished = run_with_progress(study, options.out, options.lpips_weights, options.reuse_other_code).finished
        gain = task_gain(finished)
        if gain is not None:
            gains[point] = gain
            print_above_bar(f"{point}: {gain.roi:+.2f} dB in the region, {gain.full:+.2f} dB over the full image")
        _write(options.out, axes, gains)
    print(budget_table(axes, gains))
    print(f"→ {options.out / 'budget.md'}")
    return 0


def _write(folder: Path, axes: BudgetAxes, gains: dict[BudgetPoint, TaskGain]) -> None:
    """Write budget.md, budget.json and, with matplotlib, budget.png."""
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(folder / "budget.md", f"# bench budget\n\n`{command}`\n\n{budget_table(axes, gains)}".encode())
    points = [{**asdict(point), **asdict(gain)} for point, gain in gains.items()]
    write_json(folder / "budget.json", {"command": command, "points": points})
    try:
        require_matplotlib()
    except InvalidInputError:
        return
    write_curves(folder / "budget.png", budget_curves(axes, gains), "budget", "task minus uniform, PSNR in dB")
