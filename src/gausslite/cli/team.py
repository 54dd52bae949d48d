"""Run a team for the demo: parser, fusion server and agents as real processes, watched until every mission is done."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gausslite.cli.processes import ProcessGroup, ServiceProcess
from gausslite.cli.progress import MappingBar, progress_bar
from gausslite.codec.files import write_atomic
from gausslite.errors import UnavailableError
from gausslite.wire.clients import AgentClient, Export, FusionClient, is_done

_START_TIMEOUT_S = 60.0
_POLL_S = 0.25
_END_TIMEOUT_S = 5.0
_READY = "listening on "


@dataclass(frozen=True, slots=True)
class AgentPlan:
    """One robot of the team: its name, its mission and where its camera's frames come from."""

    agent_id: str
    task: str
    source: str
    frames: str
    count: int


@dataclass(frozen=True, slots=True)
class TeamPlan:
    """The team and what its agents share."""

    agents: tuple[AgentPlan, ...]
    agent_arguments: tuple[str, ...]
    voxel_size_m: float
    refine_iterations: int
    seed: int


@dataclass(frozen=True, slots=True)
class Team:
    """The running services."""

    plan: TeamPlan
    fusion_address: str
    agents: dict[str, tuple[str, ServiceProcess]]


@contextmanager
def running_team(plan: TeamPlan, out: Path) -> Iterator[Team]:
    """Start everything; leaving the block ends everything."""
    # sockets, not ports: nothing on the machine can be in their way
    with tempfile.TemporaryDirectory(prefix="gausslite-") as sockets, ProcessGroup(out / "logs") as group:
        parser = _start(group, sockets, "parser", "gausslite_parser", ())
        store = str(out / "fusion.sqlite")
        grid = ("--voxel-size", str(plan.voxel_size_m))
        fusion = _start(group, sockets, "fusion-server", "gausslite_fusion_server", ("--store", store, *grid))
        agents = {
            agent.agent_id: _start(group, sockets, agent.agent_id, "gausslite_agent", arguments)
            for agent in plan.agents
            for arguments in [_agent_arguments(plan, agent, parser[0], fusion[0], out)]
        }
        for name, (_, service) in {"parser": parser, "fusion-server": fusion, **agents}.items():
            _await_ready(name, service)
        yield Team(plan, fusion[0], agents)


def watch_missions(team: Team) -> None:
    """Show every agent's progress until all are done. Raises UnavailableError when one ends before that."""
    waiting = dict(team.agents)
    counts = {agent.agent_id: agent.count for agent in team.plan.agents}
    bars = {agent_id: MappingBar(counts[agent_id], agent_id, row) for row, agent_id in enumerate(waiting)}
    try:
        while waiting:
            time.sleep(_POLL_S)
            for agent_id, (address, service) in list(waiting.items()):
                service.require_alive()
                with _its_own_words(service), AgentClient(address) as client:
                    status = client.status()
                done = status.frames_mapped + status.frames_skipped + status.frames_dropped + status.frames_rejected
                bars[agent_id].show(done, status.gaussians, status.roi_share, status.uplink.bytes_sent)
                if is_done(status):
                    del waiting[agent_id]
    finally:
        for bar in bars.values():
            bar.close()


def collect_maps(team: Team, out: Path) -> dict[str, Path]:
    """Fetch the fused maps from the server, refining in between; each agent wrote its own map already."""
    maps = {agent_id: out / agent_id / "map.ply" for agent_id in team.agents}
    with FusionClient(team.fusion_address, deadline_s=120.0) as client:
        for strategy in ("concatenation", "vote"):
            maps[strategy] = _save(out / f"{strategy}.ply", client.export(Export(strategy)))
        if team.plan.refine_iterations > 0:
            _refine(client, team.plan)
            maps["refine"] = _save(out / "refine.ply", client.export(Export("refined")))
    return maps


def agent_report(out: Path, agent_id: str) -> dict[str, object]:
    """What the agent wrote about its mission."""
    path = out / agent_id / "report.json"
    try:
        report: dict[str, object] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UnavailableError(f"{path}: expected the agent's report, got {error}") from None
    return report


@contextmanager
def _its_own_words(service: ServiceProcess) -> Iterator[None]:
    """A service that has just ended answers no more; its log says why, and the broken call does not."""
    try:
        yield
    except UnavailableError:
        service.wait(_END_TIMEOUT_S)
        service.require_alive()
        raise


def _agent_arguments(plan: TeamPlan, agent: AgentPlan, parser: str, fusion: str, out: Path) -> tuple[str, ...]:
    return (
        *("--agent-id", agent.agent_id, "--parser", parser, "--fusion", fusion),
        *("--source", agent.source, "--frames", agent.frames, "--task", agent.task),
        *("--out", str(out / agent.agent_id), "--handover", *plan.agent_arguments),
    )


def _start(
    group: ProcessGroup, sockets: str, name: str, module: str, arguments: Sequence[str]
) -> tuple[str, ServiceProcess]:
    address = f"unix:{sockets}/{name}.sock"
    return address, group.start(name, module, ("--listen", address, *arguments))


def _await_ready(name: str, service: ServiceProcess) -> None:
    _wait_until(lambda: _READY in service.log.read_text(errors="replace"), name, service)


def _wait_until(holds: Callable[[], bool], name: str, service: ServiceProcess) -> None:
    ends = time.monotonic() + _START_TIMEOUT_S
    while not holds():
        service.require_alive()
        if time.monotonic() > ends:
            raise UnavailableError(f"{name}: not ready after {_START_TIMEOUT_S:.0f} s: {service.last_line()}")
        time.sleep(_POLL_S / 5)


def _refine(client: FusionClient, plan: TeamPlan) -> None:
    with progress_bar(plan.refine_iterations, "refine", "it") as bar:
        for progress in client.refine(iterations=plan.refine_iterations, seed=plan.seed):
            bar.set_postfix_str(f"loss {progress.loss:.4f}, {progress.gaussians / 1e3:.1f}k Gaussians", refresh=False)
            bar.update(progress.iteration - bar.n)


def _save(path: Path, data: bytes) -> Path:
    write_atomic(path, data)
    return path
