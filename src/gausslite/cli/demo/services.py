"""Run the demo's task parser, fusion server and agents as processes until every mission is done."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gausslite.cli.demo.results_folder import STORE
from gausslite.cli.demo.scenario import AgentPlan
from gausslite.cli.demo.service_processes import ProcessGroup, ServiceProcess
from gausslite.cli.progress import MappingBar, progress_bar
from gausslite.codec.files import write_atomic
from gausslite.config.plain_values import Plain, to_toml
from gausslite.domain.errors import UnavailableError
from gausslite.wire.clients import AgentClient, Export, FusionClient, is_done

_START_TIMEOUT_S = 60.0
_POLL_S = 0.25
_END_TIMEOUT_S = 5.0
_READY = "listening on "


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """The agents' missions, and the options that all agents share."""

    agents: tuple[AgentPlan, ...]
    agent_options: Mapping[str, Plain]
    voxel_size_m: float
    refine_iterations: int
    seed: int


@dataclass(frozen=True, slots=True)
class RunningService:
    """A service and its address."""

    address: str
    process: ServiceProcess


@dataclass(frozen=True, slots=True)
class RunningServices:
    """The fusion server and the agents, by name."""

    plan: DemoPlan
    fusion_address: str
    agents: dict[str, RunningService]


@contextmanager
def running_services(plan: DemoPlan, out: Path) -> Iterator[RunningServices]:
    """Start all services, each configured by `<out>/<name>/config.toml`; leaving the block ends them."""
    # Unix sockets cannot collide with ports in use
    with tempfile.TemporaryDirectory(prefix="gausslite-") as sockets, ProcessGroup(out / "logs") as group:

        def start(name: str, module: str, options: Mapping[str, Plain]) -> RunningService:
            address = f"unix:{sockets}/{name}.sock"
            path = out / name / "config.toml"
            write_atomic(path, to_toml({"listen": address, **options}).encode())
            return RunningService(address, group.start(name, module, ("--config", str(path))))

        for name in ("parser", "fusion-server", *(agent.agent_id for agent in plan.agents)):
            (out / name).mkdir(exist_ok=True)
        parser = start("parser", "gausslite_parser", {})
        store: dict[str, Plain] = {"store": str(out / STORE), "voxel-size": plan.voxel_size_m}
        fusion = start("fusion-server", "gausslite_fusion_server", store)
        links: dict[str, Plain] = {"parser": parser.address, "fusion": fusion.address, "handover": True}
        agents = {
            agent.agent_id: start(agent.agent_id, "gausslite_agent", {**links, **_agent_options(plan, agent, out)})
            for agent in plan.agents
        }
        for name, service in {"parser": parser, "fusion-server": fusion, **agents}.items():
            _await_ready(name, service.process)
        yield RunningServices(plan, fusion.address, agents)


def watch_missions(services: RunningServices) -> None:
    """Show every agent's progress until all are done. Raises UnavailableError if one ends before that."""
    running = dict(services.agents)
    counts = {agent.agent_id: agent.frame_count for agent in services.plan.agents}
    bars = {agent_id: MappingBar(counts[agent_id], agent_id, row) for row, agent_id in enumerate(running)}
    try:
        while running:
            time.sleep(_POLL_S)
            for agent_id, service in list(running.items()):
                service.process.require_alive()
                with _failure_from_log(service.process), AgentClient(service.address) as client:
                    status = client.status()
                done = status.frames_mapped + status.frames_skipped + status.frames_dropped + status.frames_rejected
                bars[agent_id].show(done, status.gaussians, status.roi_share, status.uplink.bytes_sent)
                if is_done(status):
                    del running[agent_id]
    finally:
        for bar in bars.values():
            bar.close()


def collect_maps(services: RunningServices, out: Path) -> dict[str, Path]:
    """Return the map files by name: the agents' own, and the fused ones exported by the server."""
    maps = {agent_id: out / agent_id / "map.ply" for agent_id in services.agents}
    with FusionClient(services.fusion_address, deadline_s=120.0) as client:
        for strategy in ("concatenation", "vote"):
            maps[strategy] = _save(out / f"{strategy}.ply", client.export(Export(strategy)))
        if services.plan.refine_iterations > 0:
            _refine(client, services.plan)
            maps["refine"] = _save(out / "refine.ply", client.export(Export("refined")))
    return maps


def agent_report(out: Path, agent_id: str) -> dict[str, object]:
    """Return the report that the agent has written. Raises UnavailableError."""
    path = out / agent_id / "report.json"
    try:
        report: dict[str, object] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UnavailableError(f"{path}: expected the agent's report, got {error}") from None
    return report


@contextmanager
def _failure_from_log(service: ServiceProcess) -> Iterator[None]:
    """Raise the reason in the log, not the broken connection, if the service has just ended."""
    try:
        yield
    except UnavailableError:
        service.wait(_END_TIMEOUT_S)
        service.require_alive()
        raise


def _agent_options(plan: DemoPlan, agent: AgentPlan, out: Path) -> dict[str, Plain]:
    return {
        "agent-id": agent.agent_id,
        "source": agent.source,
        "frames": agent.frames,
        "task": agent.task,
        "out": str(out / agent.agent_id),
        **plan.agent_options,
    }


def _await_ready(name: str, service: ServiceProcess) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while _READY not in service.log.read_text(errors="replace"):
        service.require_alive()
        if time.monotonic() > deadline:
            raise UnavailableError(f"{name}: not ready after {_START_TIMEOUT_S:.0f} s: {service.last_line()}")
        time.sleep(_POLL_S / 5)


def _refine(client: FusionClient, plan: DemoPlan) -> None:
    with progress_bar(plan.refine_iterations, "refine", "it") as bar:
        for progress in client.refine(iterations=plan.refine_iterations, seed=plan.seed):
            bar.set_postfix_str(f"loss {progress.loss:.4f}, {progress.gaussians / 1e3:.1f}k Gaussians", refresh=False)
            bar.update(progress.iteration - bar.n)


def _save(path: Path, data: bytes) -> Path:
    write_atomic(path, data)
    return path
