"""Run the demo's programs as processes: the scenario, the results' folder, and the services with their logs."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.cli.progress import MappingBar, progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import Plain, to_toml
from gausslite.config.program import PREFIX
from gausslite.config.task_parser import DefaultParser
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.source import HeldOutSplit, frame_size, select_frames
from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import Region
from gausslite.mission.recording import calibrate_with_messages, open_recorded, stated_values
from gausslite.mission.results import MAP, REPORT_PAGE, require_absent
from gausslite.mission.runner import FrameStream, ground_truth_notes
from gausslite.nouns import meant_by
from gausslite.process import print_message
from gausslite.wire.clients import AgentClient, Export, FusionClient, is_done

STORE = "fusion.sqlite"
"""Name of the fusion server's file; it holds the voxels of all agents."""
_REPORT = "report.json"
_SHEETS = "pictures/[0-9][0-9][0-9]-frame-*.png"
_FUSED_MAPS = ("concatenation.ply", "vote.ply", "refine.ply")
_AGENTS = ("agent-a", "agent-b")


def require_no_demo(out: Path) -> None:
    """Raise StorageError if the folder holds results of a demo, also of one that did not end."""
    for name in (_REPORT, STORE, *(f"{agent_id}/{MAP}" for agent_id in _AGENTS)):
        require_absent(out / name)


def remove_results(out: Path) -> None:
    """Remove the report, its page and pictures, the fused maps and the fusion server's store of an earlier demo."""
    for name in (_REPORT, REPORT_PAGE, *_FUSED_MAPS, STORE, f"{STORE}-wal", f"{STORE}-shm"):
        (out / name).unlink(missing_ok=True)
    for sheet in out.glob(_SHEETS):
        sheet.unlink()


HOME_SIZE = "320x240"
_SIMD_VARIABLE = "GAUSSLITE_SIMD"
"""Chooses the instruction set of the kernels, which read it themselves."""
_HOME = "sim:home?seed={seed}&trajectory={trajectory}&frames={frames}"
_HOME_FRAMES, _HOME_VIEWS = 120, 24
_TEST_EVERY = 8


@dataclass(frozen=True, slots=True)
class AgentPlan:
    """The mission of one agent, and how many frames it maps."""

    agent_id: str
    task: str
    source: str
    frames: str
    frame_count: int


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """Sequences and tasks of the agents, and the views and regions on which their maps are scored.

    task_regions: those of each agent's task alone.
    test_every: agents keep every n-th frame from mapping; None if the held-out views are of another sequence.
    """

    agents: tuple[AgentPlan, ...]
    size: tuple[int, int]
    test_every: int | None
    held_out: tuple[FrameStream, ...]
    regions: Mapping[str, Region]
    task_regions: Mapping[str, Sequence[Region]]
    depth_registration: DepthRegistration | None = None
    camera_correction: CameraCorrection = field(default_factory=CameraCorrection)
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)

    @property
    def fit_views(self) -> bool:
        """True if views are fitted before scoring: refined keyframes shift the map against the recorded poses."""
        return not self.pose_prior.is_exact


def simulated_scenario(options: argparse.Namespace) -> Scenario:
    """Return two trajectories through one home; the held-out views are of a third one. Raises InvalidInputError."""
    if options.register_depth is not None:
        raise InvalidInputError("register-depth: expected a recorded sequence, --source SOURCE; got none")
    if options.camera_correction is not None:
        raise InvalidInputError("camera-correction: expected a recorded sequence, --source SOURCE; got none")
    specs = [
        _HOME.format(seed=options.seed, trajectory=number, frames=_HOME_VIEWS if number == 2 else _HOME_FRAMES)
        for number in range(3)
    ]
    missions, frames = [(specs[0], options.task_a), (specs[1], options.task_b)], options.frames or ":"
    agents = tuple(
        AgentPlan(f"agent-{letter}", task, spec, frames, len(select_frames(open_source(spec), frames)))
        for letter, (spec, task) in zip("ab", missions, strict=True)
    )
    held_out = open_source(specs[2])
    size = frame_size(options.size or HOME_SIZE, held_out)
    found = calibrate_with_messages(specs[2], held_out, stated_values(None, None, options.pose_prior))
    regions = _scored_regions(options, held_out.regions())
    return Scenario(
        agents,
        size,
        None,
        (FrameStream(held_out, range(len(held_out)), size),),
        regions,
        _task_regions(agents, regions),
        pose_prior=found.pose_prior,
    )


def recorded_scenario(options: argparse.Namespace) -> Scenario:
    """Return the halves of one sequence; every eighth frame is held out. Raises DatasetError, InvalidInputError."""
    recorded = open_recorded(options.source, None)
    middle = recorded.indices()[len(recorded) // 2]
    first, second = options.frames or f":{middle}", options.frames or f"{middle}:"
    size, regions = frame_size(options.size, recorded), _scored_regions(options, recorded.regions())
    for note in ground_truth_notes(options.source, recorded):
        print_message(note)
    agents, held_out_positions = [], []
    for letter, task, frames in (("a", options.task_a, first), ("b", options.task_b, second)):
        training, held_out = HeldOutSplit(_TEST_EVERY).split(select_frames(recorded, frames))
        agents.append(AgentPlan(f"agent-{letter}", task, str(options.source), frames, len(training)))
        held_out_positions.append(held_out)
    stated = stated_values(options.register_depth, options.camera_correction, options.pose_prior)
    found = calibrate_with_messages(options.source, recorded, stated)
    views = tuple(FrameStream(found.source, positions, size) for positions in held_out_positions)
    return Scenario(
        agents=tuple(agents),
        size=size,
        test_every=_TEST_EVERY,
        held_out=views,
        regions=regions,
        task_regions=_task_regions(agents, regions),
        depth_registration=found.registration,
        camera_correction=found.correction,
        pose_prior=found.pose_prior,
    )


def _scored_regions(options: argparse.Namespace, regions: Mapping[str, Region]) -> dict[str, Region]:
    """Return the objects of --objects or, without them, the targets of the tasks. Raises InvalidInputError."""
    if options.objects:
        return dict(zip(options.objects, choose_regions(regions, options.objects), strict=True))
    targets = {t for task in (options.task_a, options.task_b) for t in DefaultParser().parse(task).targets}
    chosen = _regions_of(regions, targets)
    if not chosen:
        raise InvalidInputError(
            f"demo: expected ground-truth regions of {', '.join(sorted(targets))} to score, "
            f"got {', '.join(regions) or 'none'}"
        )
    return chosen


def _regions_of(regions: Mapping[str, Region], targets: Iterable[str]) -> dict[str, Region]:
    """Return the regions of the objects that these nouns of a task mean."""
    meant = {name for target in targets for name in meant_by(target, regions)}
    return {name: roi for name, roi in regions.items() if name in meant}


def _task_regions(agents: Sequence[AgentPlan], regions: Mapping[str, Region]) -> dict[str, Sequence[Region]]:
    """Return the scored regions of each agent's task; none of them if one has none, as figures would be missing."""
    found = {agent.agent_id: _regions_of(regions, DefaultParser().parse(agent.task).targets) for agent in agents}
    return {name: list(own.values()) for name, own in found.items()} if all(found.values()) else {}


_TERMINATION_TIMEOUT_S = 10.0
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(slots=True)
class ServiceProcess:
    """A child process and the file that holds its output."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def require_alive(self) -> None:
        """Raise UnavailableError with the last line of the log if the process has failed."""
        code = self.process.poll()
        if code not in (None, 0):
            raise UnavailableError(f"{self.name} ended with code {code}: {self.last_line()} (see {self.log})")

    def last_line(self) -> str:
        """Return the last line of the log."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "its log is empty"


@dataclass(slots=True)
class ProcessGroup:
    """Owns child processes; leaving the `with` block terminates them, and kills those that do not end in time."""

    log_dir: Path
    services: list[ServiceProcess] = field(default_factory=list)

    def __enter__(self) -> ProcessGroup:
        self.log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, name: str, module: str, arguments: Sequence[str]) -> ServiceProcess:
        """Start `python -m module arguments…` with its output in `<log_dir>/<name>.log`.

        The process does not inherit variables that set options: its arguments alone configure it.
        """
        log = self.log_dir / f"{name}.log"
        command = [sys.executable, "-m", module, *arguments]
        with log.open("wb") as stream, _interrupts_deferred():
            # In a session of its own, Ctrl-C reaches only this process, which ends its children in order.
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and modules
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=without_options(os.environ),
            )
            service = ServiceProcess(name, process, log)
            self.services.append(service)
        return service

    def __exit__(self, *_: object) -> None:
        running = [service.process for service in reversed(self.services) if service.process.poll() is None]
        deadline = time.monotonic() + _TERMINATION_TIMEOUT_S
        try:
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=max(0.1, deadline - time.monotonic()))
        finally:
            # a second Ctrl-C during the wait leads here immediately
            for process in running:
                if process.poll() is None:
                    process.kill()
                    process.wait()


def without_options(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without option variables, for child processes that read their own configuration file."""
    return {name: text for name, text in environment.items() if not name.startswith(PREFIX) or name == _SIMD_VARIABLE}


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Defer interrupts to the end of the block: one between start and registration of a child would orphan it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread only
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in _INTERRUPTS}
    for number in _INTERRUPTS:
        signal.signal(number, lambda number, _frame: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


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
                bars[agent_id].show(done, status.gaussians, status.roi_share, status.hz, status.uplink.bytes_sent)
                if is_done(status):
                    del running[agent_id]
    finally:
        for bar in bars.values():
            bar.close()


def collect_maps(services: RunningServices, out: Path) -> dict[str, Path]:
    """Return the map files by name: the agents' own, and the fused ones exported by the server."""
    maps = {agent_id: out / agent_id / "map.ply" for agent_id in services.agents}
    with FusionClient(services.fusion_address, deadline_s=120.0) as client:
        strategies = {"concatenation": "concatenation", "vote": "vote"}
        if services.plan.refine_iterations > 0:
            _refine(client, services.plan)  # first: it lets the keyframes judge the vote
            strategies["refine"] = "refined"
        for name, strategy in strategies.items():
            maps[name] = _save(out / f"{name}.ply", client.export(Export(strategy)))
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
        with contextlib.suppress(subprocess.TimeoutExpired):
            service.process.wait(_END_TIMEOUT_S)
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
