"""An agent and its service in this process or another, and an estimator that tests can block and break."""

import asyncio
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import grpc
import numpy as np
from fusion_running import GRID
from serving import serving
from tiny_yolo import write_tiny_yolo

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import BallRegion, RelevanceMap
from gausslite.domain.task import TaskGraph
from gausslite.mission.settings import MissionSettings
from gausslite.perception.relevance import RegionRelevanceEstimator, RelevanceEstimate, RelevanceEstimator
from gausslite.v1 import agent_service_pb2_grpc as pb_grpc
from gausslite.wire.clients import AgentClient
from gausslite.wire.server import Service
from gausslite.wire.uplink import Uplink
from gausslite.wire.views import ChangeNotifier
from gausslite_agent.keyframe_upload import open_upload
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission import AgentMission
from gausslite_agent.servicer import AgentServicer
from gausslite_agent.settings import LoadSettings, parse_arguments
from gausslite_language.rules import RuleParser

SETTINGS = MissionSettings(max_gaussians=2000, iterations=2, threads=1)
TASK = "Pick up the mug on the table"


@dataclass
class Gate(RelevanceEstimator):
    """A relevance estimator that blocks the worker at a frame, and fails on request."""

    inner: RelevanceEstimator
    opened: threading.Event
    fail_at: int | None = None
    failure: Exception = field(default_factory=lambda: ZeroDivisionError("a bug"))
    reached: threading.Event = field(default_factory=threading.Event)

    @property
    def notes(self) -> tuple[str, ...]:
        return self.inner.notes

    def estimate(self, frame: Frame, rendered_depth_m: np.ndarray | None = None) -> RelevanceEstimate:
        self.reached.set()
        assert self.opened.wait(20)
        if frame.index == self.fail_at:
            raise self.failure
        return self.inner.estimate(frame, rendered_depth_m)

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        return self.inner.evaluate_past(frame)


def ball_estimator(_graph: TaskGraph) -> RelevanceEstimator:
    return RegionRelevanceEstimator([BallRegion((0.0, 0.0, 1.2), 0.2)])


@dataclass(frozen=True)
class Agent:
    worker: MappingWorker
    client: AgentClient
    stub: pb_grpc.AgentServiceStub


@contextmanager
def agent(
    build_estimator: object = ball_estimator,
    uplink: Uplink | None = None,
    queue_frames: int = 4,
    options: Sequence[str] = (),
    listen: str | None = None,
    added: Callable[[MappingWorker, AgentMission], list[Service]] = lambda _worker, _mission: [],
) -> Iterator[Agent]:
    loops: list[asyncio.AbstractEventLoop] = []
    notifiers: list[ChangeNotifier] = []
    on_change = lambda: loops[0].call_soon_threadsafe(lambda: notifiers[0].notify())  # noqa: E731
    keyframes = None if uplink is None else open_upload(uplink, GRID, 64, during_mission=False)
    worker = MappingWorker(
        SETTINGS,
        GRID,
        build_estimator,  # type: ignore[arg-type]
        uplink,
        on_change,
        LoadSettings(queue_frames),
        keyframe_upload=keyframes,
    )

    mission = AgentMission(parse_arguments(["--agent-id", "robot", *options]), worker, RuleParser())

    def register(server: grpc.aio.Server) -> None:
        loops.append(asyncio.get_running_loop())
        notifiers.append(ChangeNotifier())
        servicer = AgentServicer("robot", worker, mission, RuleParser(), notifiers[0])
        servicer.service().register(server)

    try:
        with (
            serving([Service("gausslite.v1.AgentService", register), *added(worker, mission)], listen) as running,
            AgentClient(running.address) as client,
            grpc.insecure_channel(running.address) as channel,
        ):
            yield Agent(worker, client, pb_grpc.AgentServiceStub(channel))
    finally:
        worker.close()


def cup_options(folder: Path) -> list[str]:
    """Return options of a small mission whose detector finds a cup in every frame."""
    model = write_tiny_yolo(folder / "tiny.onnx", ["cup"], [(32, 32, 20, 20, 0, 0.9)])
    return ["--agent-id", "robot", "--detector", str(model), "--max-gaussians", "2000", "--iterations", "1"]


@contextmanager
def agent_process(folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], AgentClient]]:
    """Start an agent in another process, with a socket in the folder; it is killed at the end."""
    address = f"unix:{folder}/agent.sock"
    command = [sys.executable, "-m", "gausslite_agent", "--listen", address, "--set", "threads=1", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            assert any("listening on" in line for line in process.stderr)
            with AgentClient(address) as client:
                yield process, client
        finally:
            process.kill()


def end(process: subprocess.Popen[str], code: int = 0, number: signal.Signals = signal.SIGTERM) -> str:
    """Send a signal and wait until the process ends with this code; returns the rest of its log."""
    assert process.stderr is not None
    process.send_signal(number)
    log = process.stderr.read()
    assert process.wait(60) == code, log
    return log
