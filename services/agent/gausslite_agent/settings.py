"""The agent's command line, read once into small sections."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.config.layers import parse_options
from gausslite.config.mapping_options import (
    add_budget,
    add_detector,
    add_policy,
    add_voxel_size,
    mission_settings,
    perception_settings,
)
from gausslite.config.source_options import add_frames
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.domain.names import require_name
from gausslite.domain.pose import UpAxis
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.mission.checkpoint import ResumeConfig
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite.task.validate import require_task_text
from gausslite.wire.address import require_callable
from gausslite.wire.tls import Tls
from gausslite.wire.uplink_values import UplinkSettings
from gausslite_agent.load import Drops, LoadSettings

_MAX_DRAIN_S = 86400.0
_IDLE_ITERATIONS = 64


@dataclass(frozen=True, slots=True)
class PlaySettings:
    """A sequence that stands in for the robot's camera; hold_out keeps every n-th frame from mapping.

    depth_registration is given when the sequence's depth is not registered to its colour.
    """

    source: str
    frames: str = ":"
    size: str | None = None
    hold_out: int | None = None
    depth_registration: DepthRegistration | None = None


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How the agent reaches the others; None = alone: tasks are parsed here, nothing is sent."""

    parser: str | None = None
    fusion: str | None = None
    mission_id: str = ""
    grid: VoxelGrid = field(default_factory=VoxelGrid)
    uplink: UplinkSettings = field(default_factory=UplinkSettings)
    spool: Path | None = None
    handover: bool = False
    drain_s: float = 120.0


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """Everything about one agent."""

    listen: str
    agent_id: str
    task: str | None
    perception: PerceptionSettings
    up_axis: UpAxis | None
    out: Path | None
    exit_when_done: bool
    play: PlaySettings | None
    link: LinkSettings
    mission: MissionSettings
    load: LoadSettings
    tls: Tls | None = None
    state: Path | None = None

    @property
    def terms(self) -> ResumeConfig:
        """What must be the same when a saved mission goes on."""
        return ResumeConfig.of(self.mission, agent_id=self.agent_id, voxel_size=f"{self.link.grid.size_m:g}")


def parse_arguments(arguments: Sequence[str] | None = None) -> AgentSettings:
    """Settings from the command line. Raises InvalidInputError for values that make no sense."""
    options = parse_options(_parser(), arguments)
    if options.source is not None and options.task is None:
        raise InvalidInputError("--task: expected a task for the source to be mapped for, got none")
    _require_sense(options)
    play = None
    if options.source is not None:
        play = PlaySettings(options.source, options.frames, options.size, options.test_every, options.register_depth)
    link = LinkSettings(
        options.parser,
        options.fusion,
        options.mission,
        VoxelGrid(options.voxel_size),
        UplinkSettings(kbps=options.uplink_kbps, interval_s=options.uplink_interval, world_frame=options.world_frame),
        options.spool,
        options.handover,
        options.drain_timeout,
    )
    return AgentSettings(
        options.listen,
        options.agent_id,
        options.task,
        perception_settings(options),
        options.up,
        options.out,
        options.exit_when_done,
        play,
        link,
        mission_settings(options),
        _load_settings(options),
        read_server_tls(options),
        options.state,
    )


def _load_settings(options: argparse.Namespace) -> LoadSettings:
    """Counted iterations make a map that can be made again, so there idle time is left idle unless asked for."""
    idle = (
        options.idle_iterations
        if options.idle_iterations is not None
        else (0 if options.rate is None else _IDLE_ITERATIONS)
    )
    return LoadSettings(options.queue, Drops(options.queue_policy), idle)


def _require_sense(options: argparse.Namespace) -> None:
    """What would show only in the middle of a mission is refused here."""
    for name in ("agent_id", "mission", "world_frame"):
        require_name(f"--{name.replace('_', '-')}", getattr(options, name))
    if not options.agent_id:
        raise InvalidInputError("--agent-id: expected a name, got an empty text")
    if not 0 <= options.drain_timeout <= _MAX_DRAIN_S:
        raise InvalidInputError(f"--drain-timeout: expected 0 to {_MAX_DRAIN_S:g} s, got {options.drain_timeout}")
    for name in ("parser", "fusion"):
        address = getattr(options, name)
        if address is not None:
            require_callable(f"--{name}", address)
    if options.task is not None:
        require_task_text(options.task)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gausslite-agent",
        description="Map for a task and stream the task's part of the map to a fusion server. With --source the agent "
        "plays a sequence as its own camera; otherwise frames come by IngestFrames.",
    )
    add = parser.add_argument
    add("--listen", default="127.0.0.1:50053", metavar="ADDRESS", help="HOST:PORT or unix:PATH; default %(default)s")
    add("--agent-id", default="agent", metavar="NAME", help="this robot's name in the team; default %(default)s")
    add("--task", metavar="TEXT", help="what the robot is to do; otherwise it waits for AssignTask")
    add("--out", metavar="DIR", type=Path, help="gets map.ply and report.json at the end of the mission")
    add("--state", metavar="FILE", type=Path, help="go on from this mission if it is there; save it here at the end")
    add("--exit-when-done", action="store_true", help="end after the mission instead of serving on")
    _add_camera(parser)
    add_frames(parser)
    add_detector(parser)
    _add_team(parser)
    add_voxel_size(parser)
    add_policy(parser)
    add_budget(parser)
    _add_load(parser)
    add_tls(parser)
    return parser


def _add_load(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("load").add_argument
    add("--queue", metavar="N", type=int, default=4, help="frames that may wait (default: %(default)s)")
    add(
        "--queue-policy",
        choices=[str(each) for each in Drops],
        default=str(Drops.OLDEST),
        help="what a full queue drops (default: oldest)",
    )
    add(
        "--idle-iterations",
        metavar="N",
        type=int,
        help="iterations while no frame waits (default: 64 at a --rate, else 0)",
    )


def _add_camera(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("camera").add_argument
    add("--source", metavar="SPEC", help='a folder or "sim:home?seed=0&trajectory=0"')
    add("--test-every", metavar="N", type=int, help="keep every N-th frame from mapping, for scoring")


def _add_team(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("team").add_argument
    add("--parser", metavar="ADDRESS", help="parser service (default: parse here by rules)")
    add("--fusion", metavar="ADDRESS", help="fusion server (default: none, nothing is sent)")
    add("--mission", metavar="ID", default="", help="the team's mission (default: the server's only one)")
    add("--world-frame", metavar="NAME", default="", help="name of the frame all poses are in (default: the server's)")
    add("--uplink-kbps", metavar="N", type=float, help="bandwidth to use, kilobits a second (default: no bound)")
    add("--uplink-interval", metavar="S", type=float, default=1.0, help="seconds between rounds; default %(default)s")
    add("--spool", metavar="FILE", type=Path, help="keep what is to be sent here, over restarts (default: in memory)")
    add("--handover", action="store_true", help="at the end also send the rest of the map and the keyframes")
    add("--drain-timeout", metavar="S", type=float, default=120.0, help="longest wait at the end; default %(default)s")
