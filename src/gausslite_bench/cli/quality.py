"""`gausslite bench quality` and `bench ablation`: how well maps show what the task is about, at the same budget."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gausslite.cli.progress import progress_bar
from gausslite.cli.source_options import open_with_warnings
from gausslite.codec.files import write_atomic
from gausslite.config.mapping_options import add_pose_prior
from gausslite.config.source_options import add_register_depth
from gausslite.config.values import AUTO, read_names, read_up_axis
from gausslite.datasets.regions import REGIONS_FILE
from gausslite.datasets.selection import downscaled_size
from gausslite.errors import InvalidInputError
from gausslite.mapping.policies import POLICIES
from gausslite.mission.build import open_models
from gausslite.mission.results import write_json
from gausslite.mission.settings import PerceptionSettings
from gausslite_bench.quality.ablation import cumulative_variants
from gausslite_bench.quality.equal_time import first_visible_scene, load_rate, measure_rate, rate_trials
from gausslite_bench.quality.home_tasks import HomeTask, choose_home_tasks
from gausslite_bench.quality.scenes import (
    REAL_CAMERA,
    HomeScenePlan,
    PosePolicy,
    RealScenePlan,
    ScenePlan,
    UnseenRegionError,
    choose_kinds,
    real_plans,
)
from gausslite_bench.quality.study import FinishedTrial, Origin, Study, TrialCache, expected_origins, run_study
from gausslite_bench.quality.tables import StudyResults, ablation_table, quality_table
from gausslite_bench.quality.trials import BudgetMode, Conditions, PerceptionMode, TrialBudget, Variant

_ABLATION_PAIR = "home-4-manipulation"
_BOTH = "both"
_RATE_FILE = "rate.json"
_HOME_SIZE = (320, 240)


def configure_quality(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench quality`."""
    add = parser.add_argument
    add("--pairs", metavar="A,B", type=read_names, default=(), help="such as home-3,home-4-search (default: all 24)")
    add("--policies", metavar="A,B", type=read_names, default=tuple(POLICIES), help="ours first (default: all there are)")
    _add_common(parser, seeds=(0,), equal=str(BudgetMode.ITERATIONS))
    add("--perception", metavar="gt|words|FILE.onnx", default="gt", help="masks given (default), or found by the task")
    parser.set_defaults(run=run_quality)


def configure_ablation(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench ablation`."""
    add = parser.add_argument
    add(
        "--pair",
        metavar="A,B",
        type=read_names,
        default=(),
        help=f"home and task (default: {_ABLATION_PAIR}, none beside a real sequence)",
    )
    _add_common(parser, seeds=(0, 1, 2), equal=_BOTH)
    parser.set_defaults(run=run_ablation)


def run_quality(options: argparse.Namespace) -> int:
    """Compare policies and write quality.md, quality.json and sheets of pictures."""
    variants = [Variant(name, name) for name in options.policies]
    if not variants:
        raise InvalidInputError(f"policies: expected names among {', '.join(POLICIES)}, got none")
    plans, own_size = _plans(options, options.pairs, ())
    conditions = Conditions(options.size or own_size, _perception_mode(options), options.threads)
    study = Study(plans, variants, _budgets(options), options.seeds, conditions)
    board = _run(study, options)
    _write(options.out, "quality", quality_table(board), board)
    return 0


def run_ablation(options: argparse.Namespace) -> int:
    """Switch the components on one by one and write ablation.md and ablation.json."""
    plans, own_size = _plans(options, options.pair, (_ABLATION_PAIR,))
    conditions = Conditions(options.size or own_size, PerceptionMode(), options.threads)
    study = Study(plans, cumulative_variants(), _budgets(options), options.seeds, conditions)
    board = _run(study, options)
    _write(options.out, "ablation", ablation_table(board), board)
    return 0


def _add_common(parser: argparse.ArgumentParser, seeds: tuple[int, ...], equal: str) -> None:
    add = parser.add_argument
    add(
        "--equal",
        choices=[*(str(each) for each in BudgetMode), _BOTH],
        default=equal,
        help="what everyone gets the same of, a frame (default: %(default)s)",
    )
    shown = ",".join(str(seed) for seed in seeds)
    add("--out", metavar="DIR", type=Path, required=True, help="gets tables and sheets; finished trials there are kept")
    add("--reuse-other-code", action="store_true", help="take finished trials of other code too (default: made again)")
    add("--seeds", metavar="N,...", type=parse_seeds, default=seeds, help=f"seeds of the mapper (default: {shown})")
    add("--size", metavar="WxH", type=size, help="image size (default: 320x240, a real sequence's in its proportions)")
    add("--frames", metavar="N", type=int, help="training frames (default: 60 in a home, all of a real sequence)")
    add("--views", metavar="N", type=int, default=24, help="held-out views in a home (default: %(default)s)")
    budget = TrialBudget()
    add("--max-gaussians", metavar="N", type=int, default=budget.max_gaussians, help="hard cap (default: %(default)s)")
    add(
        "--iterations",
        metavar="N",
        type=int,
        default=budget.iterations,
        help="a frame, when equal (default: %(default)s)",
    )
    add(
        "--rate",
        metavar="HZ",
        type=float,
        help="frames a second at equal time (default: as many as uniform mapping makes with --iterations, "
        f"measured on the first scene and kept in DIR/{_RATE_FILE})",
    )
    add("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")
    add("--lpips-weights", metavar="PATH", type=Path, action="append", default=[], help="AlexNet's and LPIPS' weights")
    add_pose_prior(parser, None, f"homes none, real {REAL_CAMERA.pose_prior}", allow_auto=False)
    add(
        "--fit-views",
        action=argparse.BooleanOptionalAction,
        help="score a second time with each view's pose and colours fitted (default: real sequences only)",
    )
    real = parser.add_argument_group("a real sequence")
    real.add_argument(
        "--real", metavar="FOLDER", type=Path, help="measure on this sequence (too, when homes are named)"
    )
    real.add_argument(
        "--roi",
        metavar="FILE.npz",
        type=Path,
        help=f"its regions (default: FOLDER/{REGIONS_FILE}), a pair a kind of object",
    )
    real.add_argument("--kinds", metavar="A,B", type=read_names, default=(), help="such as mug,chair (default: all in FILE)")
    real.add_argument("--up", metavar="X,Y,Z", type=read_up_axis, help="its upward direction, if not the source's")
    add_register_depth(real, allow_auto=True, default_text=AUTO)


def _plans(
    options: argparse.Namespace, asked: Sequence[str], usual: Sequence[str]
) -> tuple[list[ScenePlan], tuple[int, int]]:
    """The homes' pairs that are asked for and the real sequence, with neither the usual pairs; and a size for them."""
    real = _real(options)
    if real is None:
        return [*_homes(options, choose_home_tasks(asked or usual))], _HOME_SIZE
    plans, own_size = real
    return [*(_homes(options, choose_home_tasks(asked)) if asked else ()), *plans], own_size


def _homes(options: argparse.Namespace, pairs: Sequence[HomeTask]) -> list[HomeScenePlan]:
    frames, pose_policy = 60 if options.frames is None else options.frames, _pose_policy(options, PosePolicy())
    return [HomeScenePlan(pair, frames, options.views, pose_policy=pose_policy) for pair in pairs]


def _real(options: argparse.Namespace) -> tuple[list[RealScenePlan], tuple[int, int]] | None:
    """The plans of the real sequence, and a size in its proportions; None where none is asked for."""
    if options.real is None:
        for name in ("roi", "kinds"):
            if getattr(options, name):
                raise InvalidInputError(f"--{name}: expected a real sequence it belongs to, --real FOLDER; got none")
        return None
    roi = options.roi or options.real / REGIONS_FILE
    if options.roi is None and not roi.is_file():
        raise InvalidInputError(
            f"--real: expected a folder and its regions, --real FOLDER --roi FILE.npz; got none, and no {roi}"
        )
    # what is wrong with the options is told before anything is looked for in the images
    plans = real_plans(options.real, roi, options.frames, options.up, pose_policy=_pose_policy(options, REAL_CAMERA))
    chosen = choose_kinds(plans, options.kinds)
    source, camera = open_with_warnings(str(options.real), options.up, options.register_depth, AUTO)
    return [replace(plan, depth_registration=camera) for plan in chosen], downscaled_size(source.camera)


def _pose_policy(options: argparse.Namespace, usual: PosePolicy) -> PosePolicy:
    return PosePolicy(
        usual.pose_prior if options.pose_prior is None else options.pose_prior,
        usual.fit_views if options.fit_views is None else options.fit_views,
    )


def _budgets(options: argparse.Namespace) -> list[TrialBudget]:
    asked = list(BudgetMode) if options.equal == _BOTH else [BudgetMode(options.equal)]
    return [TrialBudget(options.max_gaussians, equal, options.iterations, options.rate) for equal in asked]


def _perception_mode(options: argparse.Namespace) -> PerceptionMode:
    if options.perception == "gt":
        return PerceptionMode()
    if options.perception == "words":
        return PerceptionMode(from_text=True)
    return PerceptionMode(from_text=True, detector=PerceptionSettings(Path(options.perception), threads=options.threads))


def _run(study: Study, options: argparse.Namespace) -> StudyResults:
    for plan in study.plans:
        for trial in study.trials(plan):
            _ = trial.mission  # a wrong name or number is told before hours of work, and so is a wrong file
    open_models(study.conditions.perception.detector)
    perceptual = None
    if options.lpips_weights:
        from gausslite_bench.quality.lpips import load_lpips

        perceptual = load_lpips(options.lpips_weights)
    cache = TrialCache(options.out)
    study = _with_rate(study, options.out / _RATE_FILE)
    _warn_of_other_code(expected_origins(study, cache, perceptual is not None, options.reuse_other_code))
    with _StudyBar(study.count) as bar:
        finished = run_study(study, cache, perceptual, bar, options.reuse_other_code)
    origins = Counter(each.origin for each in finished)
    print(f"trials: {', '.join(f'{count} {origin}' for origin, count in origins.items())}", file=sys.stderr)
    return StudyResults(finished)


def _with_rate(study: Study, path: Path) -> Study:
    """The study with a rate, where none was asked for."""
    trials = rate_trials(study)
    if not trials:
        return study
    rate_hz = load_rate(path, trials)
    if rate_hz is None:
        trial, scene = first_visible_scene(trials)
        with progress_bar(len(scene.training), f"uniform mapping of {trial.plan.name}", "frame") as bar:
            rate_hz = measure_rate(path, trial, scene, partial(_advance, bar))
    what = f"{1e3 / rate_hz:.3g} ms a frame, as uniform mapping takes for {trials[0].budget}"
    print(f"equal time: {what} ({path})", file=sys.stderr)
    return study.with_rate(rate_hz)


def _advance(bar: tqdm[Any], gaussians: int) -> None:
    del gaussians
    bar.update(1)


def _warn_of_other_code(expected: Counter[Origin]) -> None:
    """Before hours of work: whoever knows that the code's change leaves the figures alone can stop and keep them."""
    if again := expected[Origin.RECOMPUTED]:
        line = f"{again} finished trials of other code will be made again; --reuse-other-code takes them as they are"
        print(line, file=sys.stderr)
    if reused := expected[Origin.CACHED_OTHER_CODE]:
        line = f"{reused} finished trials of other code are taken as they are: figures may not compare"
        print(line, file=sys.stderr)


class _StudyBar:
    """A bar over trials, and a line for each."""

    def __init__(self, count: int) -> None:
        self._bar = progress_bar(count, "trials", "trial")
        self._on_terminal = sys.stderr.isatty()
        self._frames = 0

    def __enter__(self) -> _StudyBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def frame(self, gaussians: int) -> None:
        """Show that a trial goes on."""
        self._frames += 1
        text = f"frame {self._frames}, {gaussians / 1e3:.1f}k Gaussians"
        self._bar.set_postfix_str(text, refresh=self._on_terminal)

    def on_skipped(self, trials: int, why: UnseenRegionError) -> None:
        """Say which scene is not measured, and why."""
        self._bar.write(f"left out: {why}", file=sys.stderr)
        self._bar.update(trials)

    def finished(self, done: FinishedTrial) -> None:
        """Leave the trial's figures on the screen."""
        self._frames = 0
        trial, scores = done.trial, done.result.scores
        roi = "no view shows the region" if scores.roi_psnr is None else f"ROI {scores.roi_psnr:.2f} dB"
        how = "" if done.origin is Origin.COMPUTED else f" ({done.origin})"
        self._bar.write(
            f"{trial.plan.name} {trial.variant.label} equal {trial.budget.equal} seed {trial.seed}: "
            f"{roi}, full {scores.full_psnr:.2f} dB{how}",
            file=sys.stderr,
        )
        self._bar.update()


def _write(folder: Path, name: str, table: str, board: StudyResults) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    text = f"# bench {name}\n\n`{command}`\n\n{table}"
    write_atomic(folder / f"{name}.md", text.encode())
    write_json(folder / f"{name}.json", {"command": command, **board.as_json()})
    print(table)
    print(f"→ {folder / f'{name}.md'}")


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read "N,N"; argparse reports what is wrong."""
    parts = read_names(text)
    if not parts or not all(part.isascii() and part.isdigit() and len(part) < 10 for part in parts):
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 0,1,2, got {text!r}")
    return tuple(int(part) for part in parts)


def size(text: str) -> tuple[int, int]:
    """Read "WxH"; argparse reports what is wrong."""
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and 16 <= int(side[:6]) <= 4096 for side in sides):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT with sides of 16 to 4096, got {text!r}")
    return int(sides[0]), int(sides[1])
