"""`gausslite bench task-change`: recovery of map quality after the task changes during a mission."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from gausslite.cli.progress import print_above_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import split_names
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import prepare_folder, write_json
from gausslite.mission.settings import MissionSettings
from gausslite_bench.plots import require_matplotlib, write_curves
from gausslite_bench.task_change import Recovery, TaskChange, TaskChangeBench, recovery_table

_CHANGES = (
    "home-4-manipulation:home-4-navigation",
    "home-1-search:home-1-navigation",
    "home-8-navigation:home-8-search",
)


def configure_task_change(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench task-change`."""
    add = parser.add_argument
    add(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder for task-change.md, task-change.json and task-change.png",
    )
    add(
        "--changes",
        metavar="A:B,...",
        type=split_names,
        default=_CHANGES,
        help=f"pairs of tasks in one home, first:second (default: {','.join(_CHANGES)})",
    )
    add("--before", metavar="N", type=int, default=48, help="frames before the change (default: %(default)s)")
    add("--after", metavar="N", type=int, default=48, help="frames after the change (default: %(default)s)")
    add("--views", metavar="N", type=int, default=12, help="held-out views (default: %(default)s)")
    add("--max-gaussians", metavar="N", type=int, default=60_000, help="hard cap (default: %(default)s)")
    add("--iterations", metavar="N", type=int, default=8, help="iterations per frame (default: %(default)s)")
    add("--rate", metavar="HZ", type=float, default=4.0, help="frame rate in Hz (default: %(default)s)")
    parser.add_argument(
        "--timed", action="store_true", help="run as many iterations as fit into 1/rate seconds, not --iterations"
    )
    add("--seed", metavar="S", type=int, default=0, help="seed of all random numbers (default: 0)")
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    parser.set_defaults(run=run_task_change)


def run_task_change(options: argparse.Namespace) -> int:
    """Run the benchmark and rewrite the files after each change, so that an interrupt loses one change at most."""
    settings = MissionSettings(
        max_gaussians=options.max_gaussians,
        iterations=None if options.timed else options.iterations,
        rate_hz=options.rate if options.timed else None,
        seed=options.seed,
        threads=options.threads,
    )
    changes = [TaskChange.parse(text) for text in options.changes]
    if not changes:
        raise InvalidInputError(f"changes: expected such as {_CHANGES[0]}, got none")
    require_matplotlib()
    bench = TaskChangeBench(settings, options.rate, options.before, options.after, options.views)
    prepare_folder(options.out)
    recoveries: list[Recovery] = []
    for change in changes:
        recoveries.append(bench.run(change))
        print_above_bar(recovery_table(recoveries[-1:]).splitlines()[-1])
        _write(options.out, recoveries)
    print(recovery_table(recoveries))
    print(f"→ {options.out / 'task-change.md'}")
    return 0


def _write(folder: Path, recoveries: Sequence[Recovery]) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(
        folder / "task-change.md", f"# bench task-change\n\n`{command}`\n\n{recovery_table(recoveries)}".encode()
    )
    write_json(
        folder / "task-change.json", {"command": command, "changes": [recovery.as_json() for recovery in recoveries]}
    )
    panels = {recovery.change.name: recovery.points for recovery in recoveries}
    write_curves(folder / "task-change.png", panels, "seconds of mapping since the change", "ROI PSNR in dB")
