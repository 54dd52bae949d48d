"""`gausslite bench team`: quality of fused maps by strategy and policy, and what the agents send for it."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.files import write_atomic
from gausslite.config.switches import add_switch
from gausslite.config.values import read_names
from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.policies import POLICIES
from gausslite.mission.results import as_text, prepare_folder, write_json
from gausslite.mission.settings import MissionSettings
from gausslite_bench.cli.argument_types import read_image_size, read_seeds
from gausslite_bench.team.bench import TeamResult, TeamTrial, run_trial
from gausslite_bench.team.frame_errors import FrameError
from gausslite_bench.team.late_joiner import late_joiner_table, run_late_joiner
from gausslite_bench.team.scenes import TeamPlan
from gausslite_bench.team.tables import team_table

_SIZE = (320, 240)


def configure_team(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench team`."""
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, required=True, help="folder for team.md and team.json")
    add("--homes", metavar="N,...", type=read_names, default=("1",), help="homes, 1 to 8 (default: 1)")
    add("--team-sizes", metavar="N,...", type=read_names, default=("2",), help="numbers of agents, 2 to 4 (default: 2)")
    add(
        "--policies",
        metavar="A,B",
        type=read_names,
        default=("task", "uniform", "splatam", "monogs", "gaussian-slam"),
        help="policies (default: task and the four baselines)",
    )
    add("--seeds", metavar="N,...", type=read_seeds, default=(0,), help="mapping seeds (default: 0)")
    add("--size", metavar="WxH", type=read_image_size, default=_SIZE, help="image size (default: 320x240)")
    add("--frames", metavar="N", type=int, default=60, help="frames of each agent (default: %(default)s)")
    add("--views", metavar="N", type=int, default=16, help="held-out views (default: %(default)s)")
    add("--max-gaussians", metavar="N", type=int, default=60_000, help="hard cap of each agent (default: %(default)s)")
    add("--iterations", metavar="N", type=int, default=8, help="iterations per frame (default: %(default)s)")
    add(
        "--refine-iterations",
        metavar="N",
        type=int,
        default=300,
        help="joint refinement; 0: none (default: %(default)s)",
    )
    add(
        "--frame-error",
        metavar="M,DEG,DRIFT",
        type=_read_frame_error,
        default=FrameError(),
        help="shift, turn and drift (share of the way) of all agents' frames except the first's (default: none)",
    )
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    add_switch(parser, "--late-joiner", "only measure a robot that joins late, alone and with the team's map")
    add_switch(parser, "--json", "print JSON for scripts")
    parser.set_defaults(run=run_team)


def run_team(options: argparse.Namespace) -> int:
    """Run the trials; the files are rewritten after each, so that an interrupt loses one trial at most."""
    trials = _trials(options)
    prepare_folder(options.out)
    if options.late_joiner:
        return _run_late_joiner(options, trials)
    results: list[TeamResult] = []
    frames = sum(trial.plan.agents * trial.plan.frames for trial in trials)
    with progress_bar(frames, "team", "frame") as bar:
        for trial in trials:
            results.append(run_trial(trial, trial.plan.load(trial.size), lambda _: _count(bar)))
            _write(options.out, results)
            print_above_bar(team_table(results[-1:]).splitlines()[-1])
    print(as_text({"trials": [each.as_json() for each in results]}) if options.json else team_table(results))
    return 0


def _count(bar: tqdm[Any]) -> None:
    bar.update()


def _run_late_joiner(options: argparse.Namespace, trials: Sequence[TeamTrial]) -> int:
    """Measure each scene, policy and seed; write late-joiner.md and .json."""
    results = []
    for trial in trials:
        results.append(run_late_joiner(trial.plan, trial.settings, trial.size, trial.grid))
        print_above_bar(results[-1].row)
    command, table = shlex.join(["gausslite", *sys.argv[1:]]), late_joiner_table(results)
    write_atomic(options.out / "late-joiner.md", f"# bench team\n\n`{command}`\n\n{table}".encode())
    report = {"command": command, "scenes": [asdict(each) for each in results]}
    write_json(options.out / "late-joiner.json", report)
    print(as_text(report) if options.json else table)
    return 0


def _trials(options: argparse.Namespace) -> list[TeamTrial]:
    """Return the trials; invalid names and numbers fail here. Raises InvalidInputError."""
    unknown = [name for name in options.policies if name not in POLICIES]
    if unknown or not options.policies:
        raise InvalidInputError(
            f"policies: expected names among {', '.join(POLICIES)}, got {', '.join(unknown) or 'none'}"
        )
    plans = [
        TeamPlan(_number("homes", home), _number("team-sizes", agents), options.frames, options.views)
        for home in options.homes
        for agents in options.team_sizes
    ]
    return [
        TeamTrial(
            plan,
            policy,
            seed,
            MissionSettings(
                policy=policy,
                max_gaussians=options.max_gaussians,
                iterations=options.iterations,
                seed=seed,
                threads=options.threads,
            ),
            options.size,
            options.refine_iterations,
            options.frame_error,
        )
        for plan in plans
        for policy in options.policies
        for seed in options.seeds
    ]


def _number(name: str, text: str) -> int:
    if not text.isdecimal():
        raise InvalidInputError(f"--{name}: expected whole numbers, got {text!r}")
    return int(text)


def _read_frame_error(text: str) -> FrameError:
    try:
        shift_m, rotation_deg, drift = (float(part) for part in text.split(","))
        return FrameError(shift_m, rotation_deg, drift)
    except (ValueError, InvalidInputError):
        raise argparse.ArgumentTypeError(
            f"expected metres, degrees and a share such as 0.05,2,0, got {text!r}"
        ) from None


def _write(folder: Path, results: Sequence[TeamResult]) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(folder / "team.md", f"# bench team\n\n`{command}`\n\n{team_table(results)}".encode())
    write_json(folder / "team.json", {"command": command, "trials": [each.as_json() for each in results]})
