"""`gausslite bench chaos`: a fusion server and its agents under kills, partitions, wrong clocks and a full disk."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.chaos.run import ChaosResult, ChaosSettings, run_chaos
from gausslite_bench.chaos.sharing import SharingChaosResult, SharingChaosSettings, run_sharing_chaos

_MAX_AGENTS = 32


def configure_chaos(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench chaos`."""
    add, defaults = parser.add_argument, ChaosSettings()
    add("--kills", type=int, default=defaults.kills, metavar="N", help="kills and partitions (default: %(default)s)")
    add("--agents", type=int, default=defaults.agents, metavar="N", help="agents that send (default: %(default)s)")
    add("--seed", type=int, default=defaults.seed, metavar="N", help="seed of all faults (default: %(default)s)")
    add("--servers", type=int, default=3, metavar="N", help="servers that share --store (default: %(default)s)")
    add(
        "--store",
        metavar="postgresql://USER@HOST/DATABASE",
        help="servers share a database made beside this one: kills, partitions between servers, and lost connections",
    )
    add("--out", type=Path, metavar="FOLDER", help="keep the store, the journals and the logs there (default: no)")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_command)


def run_command(options: argparse.Namespace) -> int:
    """Run the faults; the exit code is 1 if anything acknowledged is lost or differs."""
    if options.kills < 1:
        raise InvalidInputError(f"--kills: expected at least 1, got {options.kills}")
    if not 1 <= options.agents <= _MAX_AGENTS:
        raise InvalidInputError(f"--agents: expected 1 to {_MAX_AGENTS}, got {options.agents}")
    if options.store:
        return _run_sharing(options)
    settings = ChaosSettings(options.kills, options.agents, options.seed, options.out)
    with progress_bar(settings.kills, "chaos", "fault") as progress:
        result = run_chaos(settings, progress.update)
    values = asdict(result) | {"seed": settings.seed, "agents": settings.agents, "correct": result.is_correct}
    sys.stdout.write(json.dumps(values, indent=1) + "\n" if options.json else "\n".join(_lines(result)) + "\n")
    return 0 if result.is_correct else 1


def _run_sharing(options: argparse.Namespace) -> int:
    settings = SharingChaosSettings(options.store, options.servers, options.kills, options.agents, options.seed)
    with progress_bar(settings.faults, "chaos", "fault") as progress:
        result = run_sharing_chaos(settings, progress.update)
    if options.json:
        sys.stdout.write(json.dumps(asdict(result) | {"seed": settings.seed, "correct": result.is_correct}) + "\n")
    else:
        sys.stdout.write("\n".join(_sharing_lines(result)) + "\n")
    return 0 if result.is_correct else 1


def _sharing_lines(result: SharingChaosResult) -> Iterator[str]:
    yield ", ".join(f"{count} {name}" for name, count in result.faults.items())
    yield (
        f"acknowledged: {result.acknowledged_messages} messages; database compared {result.comparisons} times: "
        f"{result.lost} voxels lost, {result.wrong} wrong; at the end {result.voxels} voxels, {result.extra_at_end} "
        "not acknowledged"
    )
    same = "bit for bit the offline map" if result.same_map else "NOT the offline map"
    slowest = max(result.failovers_s, default=0.0)
    yield (
        f"fused map: {same}; slowest failover {slowest:.1f} s; {result.server_errors} unexpected errors; "
        f"{result.time_s:.0f} s"
    )


def _lines(result: ChaosResult) -> Iterator[str]:
    yield ", ".join(f"{count} {name}" for name, count in result.faults.items())
    yield (
        f"acknowledged: {result.acknowledged_messages} messages with {result.acknowledged_updates} voxel updates; "
        f"{result.disk_errors} disk errors in the log"
    )
    yield (
        f"store compared {result.comparisons} times: {result.lost} acknowledged voxels lost, {result.wrong} wrong; at "
        f"the end {result.voxels} voxels of all agents, {result.extra_at_end} not acknowledged"
    )
    same = "bit for bit the offline map" if result.same_map else "NOT the offline map"
    watch = "the same" if result.same_watch else "NOT the same"
    yield f"fused map of {result.fused_voxels} voxels: {same}; a watcher has {watch}"
    end_mib, peak_mib = result.rss_mib
    yield (
        f"{result.time_s:.0f} s; server: memory {end_mib:.0f} MiB at the end, {peak_mib:.0f} MiB at most; "
        f"{result.server_errors} unexpected errors"
    )
