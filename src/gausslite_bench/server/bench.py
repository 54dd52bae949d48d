"""Measure a fusion server: agents at 4 Hz, snapshot, restart and memory, by the Gaussians that it holds."""

from __future__ import annotations

import shlex
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.config.option import option
from gausslite.domain.errors import InvalidInputError
from gausslite.fusion.limits import Quotas
from gausslite.wire.clients import FusionClient
from gausslite_bench.cli.study_options import one_or_more
from gausslite_bench.report import Report
from gausslite_bench.server.agent_load import RATE_HZ, AgentLoad
from gausslite_bench.server.hostile import ATTACKS, measure_attack
from gausslite_bench.server.stages import stages_ms
from gausslite_bench.server.synthetic_updates import GAUSSIANS_PER_VOXEL
from gausslite_bench.service_process import FUSION_SERVER, ServiceProcess

_OTHERS = {
    "ParserService": "gausslite_parser",
    "AgentService": f"gausslite_agent --source sim:home --task 'Pick up the mug' --rate {RATE_HZ}",
}


@dataclass(frozen=True, slots=True)
class ServerBenchSettings:
    """The options of `bench server`."""

    held: tuple[int, ...] = option((0, 1_000_000), "Gaussians that the server holds", metavar="N,N")
    agents: tuple[int, ...] = option(
        (8, 16, 32, 64), "agents that send updates at 4 Hz, and objects and keyframes as real agents do", metavar="N,N"
    )
    seconds: float = option(10.0, "duration of each load", low=0.1)
    server: str = option(FUSION_SERVER, "starts the server (default: with its default options)", metavar="COMMAND")
    hostile: tuple[str, ...] = option(
        (),
        f"only measure good callers under these attacks, each on a new server: all, or some of {', '.join(ATTACKS)}",
        metavar="A,B",
        convert=one_or_more(("all", *ATTACKS)),
    )

    def __post_init__(self) -> None:
        for name, counts, least in (("held", self.held, 0), ("agents", self.agents, 1)):
            if not counts or min(counts) < least:
                raise InvalidInputError(f"--{name}: expected numbers of at least {least}, got {counts}")


def run_server(settings: ServerBenchSettings) -> Report:
    """Measure a server for each number of Gaussians held, or for each attack."""
    if settings.hostile:
        names = list(ATTACKS) if "all" in settings.hostile else list(settings.hostile)
        attacks = []
        with progress_bar(len(names), "attacks", "attack") as progress:
            for name in names:
                with _new_server(settings, ATTACKS[name].service) as server:
                    attacks.append(measure_attack(name, server, settings.held[0], settings.seconds))
                progress.update()
        return Report({"server": settings.server, "held": settings.held[0], "attacks": attacks})
    results = []
    with progress_bar(len(settings.held), "server", "server") as progress:
        for held in settings.held:
            with _new_server(settings) as server:
                results.append(_measure(settings, held, server, progress.set_description))
            progress.update()
    stages = [{"agents": agents, **stages_ms(agents)} for agents in settings.agents]
    return Report({"server": settings.server, "servers": results, "stages_ms": stages})


@contextmanager
def _new_server(settings: ServerBenchSettings, service: str = "FusionService") -> Iterator[ServiceProcess]:
    """Start the fusion server, or another service; the parser at a port, where it can tell its callers apart."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        command, address = f"{settings.server} --store {folder}/store.sqlite", ""
        if max(settings.agents) > Quotas().agents and "quota-agents" not in command:
            command += f" --set quota-agents={max(settings.agents)}"
        if service != "FusionService":
            # an agent without a task's relevance needs no detector
            command = f"{shlex.quote(sys.executable)} -m {_OTHERS[service]}"
        if service == "ParserService":
            with socket.create_server(("127.0.0.1", 0)) as free:
                address = f"127.0.0.1:{free.getsockname()[1]}"
        yield stack.enter_context(closing(ServiceProcess(command, Path(folder), address=address)))


def _measure(
    settings: ServerBenchSettings, held: int, server: ServiceProcess, on_progress: Callable[[str], None]
) -> dict[str, object]:
    load = AgentLoad(server.address)
    on_progress(f"{held} Gaussians: fill")
    load.fill(held, GAUSSIANS_PER_VOXEL)
    loads = []
    for agents in settings.agents:
        on_progress(f"{held} Gaussians: {agents} agents")
        cpu_s = server.cpu_s()
        result = load.run(agents, settings.seconds)
        loads.append({**asdict(result), "server_cpu_ms": 1000 * (server.cpu_s() - cpu_s) / result.messages})
    on_progress(f"{held} Gaussians: snapshot, restart")
    return {
        "held": held,
        "loads": loads,
        "snapshot_s": _snapshot_s(server.address),
        "rss_mib": server.rss_mib(),
        "restart_s": server.restart(),
    }


def _snapshot_s(address: str) -> float:
    """Return the time until a new watcher has the whole map."""
    with FusionClient(address, deadline_s=600.0) as client:
        begin_s = time.monotonic()
        watch = client.watch()
        while not next(watch).last:
            pass
        return time.monotonic() - begin_s
