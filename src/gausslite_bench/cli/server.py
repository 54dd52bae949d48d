"""`gausslite bench server`: the fusion server under the load of many agents."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict

from gausslite.cli.progress import progress_bar
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.server.agent_load import RATE_HZ, LoadResult
from gausslite_bench.server.bench import P99_LIMIT_MS, ServerBenchSettings, StoredSizeResult, measure
from gausslite_bench.server.hostile import ATTACKS, AttackResult, measure_attack
from gausslite_bench.server.server_process import DEFAULT_COMMAND
from gausslite_bench.server.sharing import SharingResult, measure_sharing
from gausslite_bench.server.stages import measure_stages


def configure_server(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench server`."""
    add = parser.add_argument
    add("--held", default="0,1000000", metavar="N,N", help="Gaussians that the server holds (default: %(default)s)")
    add(
        "--agents",
        default="8,16,32,64",
        metavar="N,N",
        help="agents that send updates at 4 Hz, and objects and keyframes as real agents do (default: %(default)s)",
    )
    add("--seconds", type=float, default=10.0, metavar="S", help="duration of each load (default: %(default)s)")
    add(
        "--store",
        default="sqlite",
        metavar="STORE",
        help="sqlite, memory, or with --servers postgresql://USER@HOST/DATABASE, beside which databases are made "
        "(default: %(default)s)",
    )
    add(
        "--servers",
        metavar="N,N",
        help="measure so many servers that share a mission, with the first numbers of --held and --agents",
    )
    add("--watchers", type=int, default=20, metavar="N", help="watchers that stop reading (default: %(default)s)")
    add(
        "--server",
        default=DEFAULT_COMMAND,
        metavar="COMMAND",
        help="starts the server, with its default options unless the command has others",
    )
    parser.add_argument(
        "--hostile",
        metavar="ATTACK,ATTACK",
        help=f"only measure 4 agents under these attacks, each on a new server: all, or some of {', '.join(ATTACKS)}",
    )
    parser.add_argument(
        "--stages",
        action="store_true",
        help="only measure the stages of a message in this process: CPU and bytes written, without gRPC",
    )
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_server)


def run_server(options: argparse.Namespace) -> int:
    """Measure a server for each number of Gaussians held."""
    if not options.seconds > 0:
        raise InvalidInputError(f"--seconds: expected more than 0, got {options.seconds:g}")
    if options.hostile:
        return _run_attacks(options)
    if options.stages:
        return _run_stages(max(int(options.seconds * RATE_HZ), 1), options.json)
    is_database = options.store.startswith("postgresql://")
    if not is_database and options.store not in ("sqlite", "memory"):
        raise InvalidInputError(f"--store: expected sqlite, memory or postgresql://..., got {options.store!r}")
    if options.servers is not None:
        if not is_database:
            raise InvalidInputError("--servers: expected a database as --store, postgresql://USER@HOST/DATABASE")
    elif is_database:
        raise InvalidInputError("--store postgresql://...: expected --servers too, for example --servers 1,2,4")
    settings = ServerBenchSettings(
        held=_numbers("--held", options.held, 0),
        agents=_numbers("--agents", options.agents, 1),
        seconds=options.seconds,
        command=options.server,
        store=options.store,
        watchers=options.watchers,
    )
    if options.servers is not None:
        return _run_sharing(settings, _numbers("--servers", options.servers, 1), options.json)
    with progress_bar(len(settings.held), "server", "server") as progress:
        results = []
        if not options.json:
            progress.write(_title(settings.command, settings.store))
        for held in settings.held:
            results.append(measure(settings, held, progress.set_description))
            progress.update()
            if not options.json:
                progress.write("\n".join(_lines(results[-1])))
    if options.json:
        sys.stdout.write(json.dumps([_values(settings, result) for result in results], indent=1) + "\n")
    return 0


def _run_sharing(settings: ServerBenchSettings, counts: list[int], is_json: bool) -> int:
    results = []
    with progress_bar(len(counts), "servers", "servers") as progress:
        if not is_json:
            progress.write(f"{_title(settings.command, settings.store)} that the servers share, so frames are trusted")
        for count in counts:
            results.append(measure_sharing(settings, count, progress.set_description))
            progress.update()
            if not is_json:
                progress.write(_sharing_line(results[-1]))
    if is_json:
        sys.stdout.write(json.dumps([asdict(result) for result in results], indent=1) + "\n")
    return 0


def _sharing_line(result: SharingResult) -> str:
    failover = "" if result.failover_s is None else f"; a server killed: {result.failover_s:.1f} s"
    return (
        f"{result.servers} servers, {result.agents} agents, {result.held} Gaussians held: CPU per message "
        f"{result.server_cpu_ms:.2f} ms of servers, {result.database_cpu_ms:.2f} ms of the database; p50 "
        f"{result.p50_ms:.0f} ms, p99 {result.p99_ms:.0f} ms, {result.missing} missing; received {result.received}, "
        f"stored parts {result.stored}, foreign {result.foreign}{failover}"
    )


def _run_stages(count: int, is_json: bool) -> int:
    results = {
        f"{name} voxels, groups of {group}": measure_stages(group, name == "scattered", count)
        for name in ("near", "scattered")
        for group in (1, 8)
    }
    if is_json:
        sys.stdout.write(json.dumps({title: asdict(result) for title, result in results.items()}, indent=1) + "\n")
        return 0
    for title, result in results.items():
        sys.stdout.write(
            f"{title}: decode {result.decode_ms:.2f} ms, store {result.store_ms:.2f} ms, checks, vote and log "
            f"{result.other_ms:.2f} ms; {result.message_bytes} bytes received, {result.written_bytes} written\n"
        )
    return 0


def _run_attacks(options: argparse.Namespace) -> int:
    names = list(ATTACKS) if options.hostile == "all" else options.hostile.split(",")
    unknown = [name for name in names if name not in ATTACKS]
    if unknown:
        raise InvalidInputError(f"--hostile: expected all, or some of {', '.join(ATTACKS)}, got {unknown[0]!r}")
    held = _numbers("--held", options.held, 0)[0]
    results = []
    with progress_bar(len(names), "attacks", "attack") as progress:
        if not options.json:
            progress.write(f"{_title(options.server, options.store)}, {held} Gaussians held")
        for name in names:
            progress.set_description(name)
            results.append(measure_attack(name, options.server, options.store, held, options.seconds))
            progress.update()
            if not options.json:
                progress.write("\n".join(_attack_lines(results[-1])))
    if options.json:
        sys.stdout.write(json.dumps([asdict(result) for result in results], indent=1) + "\n")
    return 0


def _attack_lines(result: AttackResult) -> Iterator[str]:
    quiet, attacked = result.quiet, result.attacked
    yield f"{result.attack}: {ATTACKS[result.attack][0]}"
    yield (
        f"  p99 {quiet.p99_ms:.1f} -> {attacked.p99_ms:.1f} ms, {attacked.missing} of {attacked.messages} not "
        f"acknowledged, {attacked.refused} reports refused, {result.rss_mib:.0f} {result.rss_growth_mib:+.0f} MiB"
    )
    yield f"  health: {result.unhealthy:.0%} not SERVING, slowest answer {result.slowest_health_ms:.0f} ms"
    yield f"  log: {len(result.log)} lines{', the last: ' if result.log else ''}{result.log[-1] if result.log else ''}"


def _numbers(name: str, text: str, least: int) -> list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < least:
        raise InvalidInputError(f"{name}: expected whole numbers of at least {least} between commas, got {text!r}")
    return numbers


def _title(command: str, store: str) -> str:
    """Return the configuration of the server."""
    options = "default options" if command == DEFAULT_COMMAND else command
    places = {"memory": "memory", "sqlite": "a file"}
    return f"fusion server, {options}, store in {places.get(store, 'a database')}"


def _values(settings: ServerBenchSettings, result: StoredSizeResult) -> dict[str, object]:
    return {"server": _title(settings.command, settings.store)} | asdict(result) | {"largest_team": result.largest_team}


def _lines(result: StoredSizeResult) -> Iterator[str]:
    yield f"{result.held} Gaussians held (filled in {result.fill_s:.1f} s)"
    yield f"  largest team with p99 < {P99_LIMIT_MS:g} ms: {result.largest_team} agents"
    for load in result.loads:
        yield f"{_load_line(load)}, server {load.server_cpu_ms:.1f} ms of CPU per message"
    yield (
        f"  snapshot {result.snapshot_s:.2f} s, status {result.status_ms:.1f} ms, restart {result.restart_s:.1f} s, "
        f"memory {result.rss_mib:.0f} MiB, watchers that do not read {result.watchers_mib:.0f} MiB"
    )


def _load_line(load: LoadResult) -> str:
    times = f"p50 {load.p50_ms:.1f} ms, p99 {load.p99_ms:.1f} ms"
    refused = f", {load.refused} reports refused" if load.refused else ""
    return f"  {load.agents} agents: {times}, {load.missing} of {load.messages} not acknowledged{refused}"
