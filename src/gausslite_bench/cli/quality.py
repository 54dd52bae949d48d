"""`gausslite bench quality` and `bench ablation`: quality of maps on held-out views at an equal budget."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gausslite.cli.source_options import open_with_warnings
from gausslite.config.mapping_options import add_pose_prior
from gausslite.config.source_options import add_register_depth
from gausslite.config.switches import add_switch
from gausslite.config.values import AUTO, read_names, read_up_axis
from gausslite.datasets.regions import REGIONS_FILE
from gausslite.datasets.selection import downscaled_size
from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.policies import POLICIES
from gausslite.mission.settings import PerceptionSettings
from gausslite_bench.cli.argument_types import read_image_size, read_seeds
from gausslite_bench.cli.study_progress import RATE_FILE, run_with_progress, write_results
from gausslite_bench.quality.ablation import cumulative_variants
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import HomeTask, choose_home_tasks
from gausslite_bench.quality.real_scenes import REAL_CAMERA, RealScenePlan, choose_kinds, real_plans
from gausslite_bench.quality.scenes import PosePolicy, ScenePlan
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.tables import ablation_table, quality_table
from gausslite_bench.quality.trials import BudgetMode, Conditions, PerceptionMode, TrialBudget, Variant

_ABLATION_TASK = "home-4-manipulation"
_BOTH = "both"
_HOME_FRAMES = 60
_HOME_SIZE = (320, 240)


def configure_quality(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench quality`."""
    add = parser.add_argument
    add(
        "--pairs",
        metavar="A,B",
        type=read_names,
        default=(),
        help="homes or home-task pairs such as home-3,home-4-search (default: all 24 pairs)",
    )
    add(
        "--policies",
        metavar="A,B",
        type=read_names,
        default=tuple(POLICIES),
        help="policies; tables compare the first with the best other (default: all)",
    )
    _add_study_options(parser, default_seeds=(0,), default_equal=str(BudgetMode.ITERATIONS))
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
        type=read_names,
        default=(),
        help=f"homes or home-task pairs (default: {_ABLATION_TASK}, or none with --real)",
    )
    _add_study_options(parser, default_seeds=(0, 1, 2), default_equal=_BOTH)
    parser.set_defaults(run=run_ablation)


def run_quality(options: argparse.Namespace) -> int:
    """Compare policies and write quality.md, quality.json and comparison sheets."""
    variants = [Variant(name, name) for name in options.policies]
    if not variants:
        raise InvalidInputError(f"policies: expected names among {', '.join(POLICIES)}, got none")
    plans, default_size = _scene_plans(options, options.pairs, ())
    conditions = Conditions(options.size or default_size, _perception_mode(options), options.threads)
    study = Study(plans, variants, _budgets(options), options.seeds, conditions)
    results = run_with_progress(study, options.out, options.lpips_weights, options.reuse_other_code)
    write_results(options.out, "quality", quality_table(results), results)
    return 0


def run_ablation(options: argparse.Namespace) -> int:
    """Enable the components one by one and write ablation.md and ablation.json."""
    plans, default_size = _scene_plans(options, options.pair, (_ABLATION_TASK,))
    conditions = Conditions(options.size or default_size, PerceptionMode(), options.threads)
    study = Study(plans, cumulative_variants(), _budgets(options), options.seeds, conditions)
    results = run_with_progress(study, options.out, options.lpips_weights, options.reuse_other_code)
    write_results(options.out, "ablation", ablation_table(results), results)
    return 0


def _add_study_options(parser: argparse.ArgumentParser, default_seeds: tuple[int, ...], default_equal: str) -> None:
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, required=True, help="folder for tables, sheets and cached trials")
    add_switch(parser, "--reuse-other-code", "also reuse cached trials from other code (default: compute them again)")
    seeds = ",".join(str(seed) for seed in default_seeds)
    add("--seeds", metavar="N,...", type=read_seeds, default=default_seeds, help=f"mapping seeds (default: {seeds})")
    add(
        "--size",
        metavar="WxH",
        type=read_image_size,
        help="image size (default: 320x240; real sequences keep their aspect ratio)",
    )
    add(
        "--frames",
        metavar="N",
        type=int,
        help=f"training frames (default: {_HOME_FRAMES} per home, all of a real sequence)",
    )
    add("--views", metavar="N", type=int, default=24, help="held-out views per home (default: %(default)s)")
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    add(
        "--lpips-weights",
        metavar="PATH",
        type=Path,
        action="append",
        default=[],
        help="weights of AlexNet and LPIPS; repeatable (default: LPIPS is not computed)",
    )
    add_pose_prior(parser, None, f"homes none, real {REAL_CAMERA.pose_prior}", allow_auto=False)
    add(
        "--fit-views",
        action=argparse.BooleanOptionalAction,
        help="also score with each view's pose and exposure fitted (default: real sequences only)",
    )
    _add_budget_options(parser, default_equal)
    _add_real_sequence_options(parser)


def _add_budget_options(parser: argparse.ArgumentParser, default_equal: str) -> None:
    add, budget = parser.add_argument_group("budget").add_argument, TrialBudget()
    add(
        "--equal",
        choices=[*(str(each) for each in BudgetMode), _BOTH],
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


def _add_real_sequence_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("real sequence")
    add = group.add_argument
    add("--real", metavar="FOLDER", type=Path, help="measure on this sequence; on homes too if they are named")
    add(
        "--roi",
        metavar="FILE.npz",
        type=Path,
        help=f"its regions; one task per kind of object (default: FOLDER/{REGIONS_FILE})",
    )
    add("--kinds", metavar="A,B", type=read_names, default=(), help="kinds of objects such as mug,chair (default: all)")
    add("--up", metavar="X,Y,Z", type=read_up_axis, help="the world's upward direction (default: the source's)")
    add_register_depth(group, allow_auto=True, default_text=AUTO)


def _scene_plans(
    options: argparse.Namespace, task_names: Sequence[str], default_names: Sequence[str]
) -> tuple[list[ScenePlan], tuple[int, int]]:
    """Return the scenes and a default image size: home tasks, a real sequence, or both."""
    real = _real_plans(options)
    if real is None:
        return [*_home_plans(options, choose_home_tasks(task_names or default_names))], _HOME_SIZE
    plans, size = real
    return [*(_home_plans(options, choose_home_tasks(task_names)) if task_names else ()), *plans], size


def _home_plans(options: argparse.Namespace, tasks: Sequence[HomeTask]) -> list[HomeScenePlan]:
    frames = _HOME_FRAMES if options.frames is None else options.frames
    pose_policy = _pose_policy(options, PosePolicy())
    return [HomeScenePlan(task, frames, options.views, pose_policy=pose_policy) for task in tasks]


def _real_plans(options: argparse.Namespace) -> tuple[list[RealScenePlan], tuple[int, int]] | None:
    """Return the plans of the real sequence and an image size with its aspect ratio; None without --real."""
    if options.real is None:
        for name in ("roi", "kinds"):
            if getattr(options, name):
                raise InvalidInputError(f"--{name}: expected a real sequence, --real FOLDER; got none")
        return None
    roi = options.roi or options.real / REGIONS_FILE
    if options.roi is None and not roi.is_file():
        raise InvalidInputError(
            f"--real: expected a folder and its regions, --real FOLDER --roi FILE.npz; got none, and no {roi}"
        )
    # check the options before the registration is estimated from the images
    plans = real_plans(options.real, roi, options.frames, options.up, pose_policy=_pose_policy(options, REAL_CAMERA))
    chosen = choose_kinds(plans, options.kinds)
    source, registration = open_with_warnings(str(options.real), options.up, options.register_depth, AUTO)
    return [replace(plan, depth_registration=registration) for plan in chosen], downscaled_size(source.camera)


def _pose_policy(options: argparse.Namespace, default: PosePolicy) -> PosePolicy:
    return PosePolicy(
        default.pose_prior if options.pose_prior is None else options.pose_prior,
        default.fit_views if options.fit_views is None else options.fit_views,
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
