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
from gausslite_bench.server.server_process import DEFAULT_COMMAND
from gausslite_bench.server.stages import measure_stages


def configure_server(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench server`."""
    add = parser.add_argument
    add("--held", default="0,1000000", metavar="N,N", help="Gaussians that the server holds (default: %(default)s)")
    add("--agents", default="8,16,32,64", metavar="N,N", help="agents that send at 4 Hz (default: %(default)s)")
    add("--seconds", type=float, default=10.0, metavar="S", help="duration of each load (default: %(default)s)")
    add("--store", choices=["sqlite", "memory"], default="sqlite", help="store of the server (default: %(default)s)")
    add("--watchers", type=int, default=20, metavar="N", help="watchers that stop reading (default: %(default)s)")
    add(
        "--server",
        default=DEFAULT_COMMAND,
        metavar="COMMAND",
        help="starts the server, with its default options unless the command has others",
    )
    parser.add_argument(
        "--hostile",
        action="store_true",
        help="also measure 8 agents beside one that resends a message of 200000 tombstones",
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
    if options.stages:
        return _run_stages(max(int(options.seconds * RATE_HZ), 1), options.json)
    settings = ServerBenchSettings(
        held=_numbers("--held", options.held, 0),
        agents=_numbers("--agents", options.agents, 1),
        seconds=options.seconds,
        command=options.server,
        store=options.store,
        watchers=options.watchers,
        hostile=options.hostile,
    )
    with progress_bar(len(settings.held), "server", "server") as progress:
        results = []
        if not options.json:
            progress.write(_title(settings))
        for held in settings.held:
            results.append(measure(settings, held, progress.set_description))
            progress.update()
            if not options.json:
                progress.write("\n".join(_lines(results[-1])))
    if options.json:
        sys.stdout.write(json.dumps([_values(settings, result) for result in results], indent=1) + "\n")
    return 0


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


def _numbers(name: str, text: str, least: int) -> list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or min(numbers) < least:
        raise InvalidInputError(f"{name}: expected whole numbers of at least {least} between commas, got {text!r}")
    return numbers


def _title(settings: ServerBenchSettings) -> str:
    """Return the configuration of the server."""
    command = "default options" if settings.command == DEFAULT_COMMAND else settings.command
    return f"fusion server, {command}, store in {'memory' if settings.store == 'memory' else 'a file'}"


def _values(settings: ServerBenchSettings, result: StoredSizeResult) -> dict[str, object]:
    return {"server": _title(settings)} | asdict(result) | {"largest_team": result.largest_team}


def _lines(result: StoredSizeResult) -> Iterator[str]:
    yield f"{result.held} Gaussians held (filled in {result.fill_s:.1f} s)"
    yield f"  largest team with p99 < {P99_LIMIT_MS:g} ms: {result.largest_team} agents"
    for load in result.loads:
        yield f"{_load_line(load)}, server {load.server_cpu_ms:.1f} ms of CPU per message"
    if result.hostile is not None:
        yield f"{_load_line(result.hostile)}, beside a hostile agent"
    yield (
        f"  snapshot {result.snapshot_s:.2f} s, status {result.status_ms:.1f} ms, restart {result.restart_s:.1f} s, "
        f"memory {result.rss_mib:.0f} MiB, watchers that do not read {result.watchers_mib:.0f} MiB"
    )


def _load_line(load: LoadResult) -> str:
    times = f"p50 {load.p50_ms:.1f} ms, p99 {load.p99_ms:.1f} ms"
    return f"  {load.agents} agents: {times}, {load.missing} of {load.messages} not acknowledged"
