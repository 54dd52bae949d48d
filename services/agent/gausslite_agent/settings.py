"""Settings of the agent, read from its command line, environment and configuration file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.default_addresses import AGENT_ADDRESS
from gausslite.config.layers import parse_options
from gausslite.config.mapping_options import (
    HOLD_OUT_HELP,
    add_budget,
    add_detector,
    add_policy,
    add_voxel_size,
    mission_settings,
    perception_settings,
)
from gausslite.config.numbers import Number
from gausslite.config.options_without_effect import require_effect, require_fusion_server
from gausslite.config.source_options import add_camera_correction, add_frames
from gausslite.config.switches import add_switch, set_dependent_default
from gausslite.config.tls_options import add_tls, read_server_tls
from gausslite.config.values import NONE, read_rigid_transform
from gausslite.config.view_option import add_view
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import require_identifier, require_name
from gausslite.domain.pose import UpAxis
from gausslite.domain.task_limits import require_task_text
from gausslite.domain.voxels import VoxelGrid
from gausslite.mission.settings import MissionSettings, PerceptionSettings, PoseMode, SourceSettings
from gausslite.process.messages import print_message
from gausslite.wire.address import require_callable
from gausslite.wire.tls import Tls
from gausslite.wire.uplink_values import UplinkSettings
from gausslite_agent.load import LoadSettings, QueuePolicy
from gausslite_agent.mission_end import MAX_DRAIN_S

_KEYFRAMES = 64
_MAX_KEYFRAMES = 10_000
_IDLE_ITERATIONS = 64


@dataclass(frozen=True, slots=True)
class ConnectionSettings:
    """Connections to the other services.

    parser: its address, None to parse tasks in this process; fusion: its address, None to send nothing. spool: file of
    the data that waits, None to keep it in memory. handover: at the end, also send the whole map. drain_s: the longest
    time for sending at the end of a mission; grace_s: the same after SIGTERM. keyframes: the most keyframes that the
    server has at a time; with keyframes_during_mission they are sent while mapping, not only with a handover.
    team_map: layer of the fused map that is inserted in the task's region: vote, refined or none.
    """

    parser: str | None = None
    fusion: str | None = None
    mission_id: str = ""
    grid: VoxelGrid = field(default_factory=VoxelGrid)
    uplink: UplinkSettings = field(default_factory=UplinkSettings)
    spool: Path | None = None
    handover: bool = False
    drain_s: float = 120.0
    grace_s: float = 5.0
    keyframes: int = _KEYFRAMES
    keyframes_during_mission: bool = False
    team_map: str = NONE


@dataclass(frozen=True, slots=True)
class AgentIdentity:
    """The agent id and voxel size, by which the fusion server identifies a robot's map."""

    agent_id: str
    voxel_size: float


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """All settings of one agent.

    source: the sequence that replaces the robot's camera, None for frames by IngestFrames. strict: end the mission at a
    frame of the source that cannot be read. state: file of the saved mission; it is saved every save_interval_s seconds
    (0: only at the end). view: port of the page that shows the agent, None for no page.
    """

    listen: str
    agent_id: str
    task: str | None
    perception: PerceptionSettings
    up_axis: UpAxis | None
    out: Path | None
    exit_when_done: bool
    source: SourceSettings | None
    link: ConnectionSettings
    mission: MissionSettings
    load: LoadSettings
    tls: Tls | None = None
    state: Path | None = None
    strict: bool = False
    save_interval_s: float = 0.0
    view: int | None = None

    @property
    def fixed_settings(self) -> tuple[Any, ...]:
        """The settings that must be equal when a saved mission is resumed."""
        return self.mission, AgentIdentity(self.agent_id, self.link.grid.size_m)


def parse_arguments(arguments: Sequence[str] | None = None) -> AgentSettings:
    """Return the settings of the command line. Raises InvalidInputError."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    if options.source is not None and options.task is None:
        raise InvalidInputError("--task: expected a task for the source, got none")
    _require_valid(options)
    require_effect(options)
    require_fusion_server(options)
    source = None
    if options.source is not None:
        source = SourceSettings(
            options.source,
            options.frames,
            options.size,
            options.up,
            options.test_every,
            options.register_depth,
            options.camera_correction,
            require_poses=options.poses != PoseMode.TRACK,
        )
    link = ConnectionSettings(
        options.parser,
        options.fusion,
        options.mission,
        VoxelGrid(options.voxel_size),
        UplinkSettings(
            kbps=options.uplink_kbps,
            interval_s=options.uplink_interval,
            world_frame=options.world_frame,
            T_fused_agent=options.fused_from_agent,
        ),
        options.spool,
        options.handover,
        options.drain_timeout,
        options.grace_period,
        _KEYFRAMES if options.keyframes is None else options.keyframes,
        options.handover if options.keyframes is None else options.keyframes > 0,
        options.team_map,
    )
    return AgentSettings(
        options.listen,
        options.agent_id,
        options.task,
        perception_settings(options),
        options.up,
        options.out,
        options.exit_when_done,
        source,
        link,
        mission_settings(options),
        _load_settings(options),
        read_server_tls(options),
        options.state,
        options.strict,
        options.save_interval,
        options.view,
    )


def _load_settings(options: argparse.Namespace) -> LoadSettings:
    """Return the load settings."""
    idle_iterations = options.idle_iterations
    if idle_iterations is None:
        idle_iterations = _default_idle_iterations(options)
    return LoadSettings(options.queue, QueuePolicy(options.queue_policy), idle_iterations, options.free_space)


def _default_idle_iterations(options: argparse.Namespace) -> int:
    """Return 0 without a rate, so that maps are reproducible."""
    return 0 if options.rate is None else _IDLE_ITERATIONS


def _default_keyframes(options: argparse.Namespace) -> int:
    """Return 0 without a handover: then only the task's region leaves the robot."""
    return _KEYFRAMES if options.handover else 0


def _require_valid(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for values that would fail only in the middle of a mission."""
    require_identifier("--agent-id", options.agent_id)
    if options.mission:
        require_identifier("--mission", options.mission)
    require_name("--world-frame", options.world_frame)
    for name in ("parser", "fusion"):
        address = getattr(options, name)
        if address is not None:
            require_callable(f"--{name}", address)
    if options.task is not None:
        require_task_text(options.task)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of `gausslite-agent`, without the options of configuration files."""
    parser = CommandParser(
        prog="gausslite-agent",
        description="Map the region of interest (ROI) of a task online, and send it to a fusion server. With --source "
        "the agent replays a sequence; otherwise it receives frames by the IngestFrames call.",
    )
    add = parser.add_argument
    add("--listen", default=AGENT_ADDRESS, metavar="ADDRESS", help="HOST:PORT or unix:PATH (default: %(default)s)")
    add("--agent-id", default="agent", metavar="NAME", help="unique name of this agent (default: %(default)s)")
    add("--task", metavar="TEXT", help="the robot's task (default: wait for the AssignTask call)")
    add("--out", metavar="DIR", type=Path, help="folder for map.ply and report.json; replaces earlier ones at the end")
    add("--state", metavar="FILE", type=Path, help="resume the mission saved in this file, and save it here at the end")
    add(
        "--save-interval",
        metavar="S",
        type=Number("save-interval", float, 0, MAX_DRAIN_S),
        default=60.0,
        help="seconds between two saves of --state during the mission; 0: only at the end (default: %(default)s)",
    )
    add_switch(parser, "--exit-when-done", "exit after the mission (default: continue to serve)")
    add_view(parser, "the agent")
    _add_replay(parser)
    add_frames(parser)
    add_camera_correction(parser)
    add_detector(parser)
    _add_connections(parser)
    add_voxel_size(parser)
    add_policy(parser)
    add_budget(parser)
    _add_load(parser)
    add_tls(parser)
    return parser


def _add_replay(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("replay")
    add = group.add_argument
    add("--source", metavar="SPEC", help='a sequence folder or "sim:home?seed=0&trajectory=0"')
    add("--test-every", metavar="N", type=int, help=HOLD_OUT_HELP)
    add_switch(group, "--strict", "end at a frame that cannot be read (default: skip it)")


def _add_connections(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("connections")
    add = group.add_argument
    add("--parser", metavar="ADDRESS", help="parser service (default: parse tasks in this process, by rules)")
    add("--fusion", metavar="ADDRESS", help="fusion server (default: none; nothing is sent)")
    add("--mission", metavar="ID", default="", help="mission to join (default: the server's only one)")
    add("--world-frame", metavar="NAME", default="", help="name of the frame of all poses (default: the server's)")
    add(
        "--fused-from-agent",
        metavar="X,Y,Z[,QX,QY,QZ,QW]",
        type=read_rigid_transform,
        help="pose of this agent's world frame in the fused map's frame, if it is known (default: the same frame)",
    )
    add("--uplink-kbps", metavar="N", type=float, help="bandwidth limit in kilobits per second (default: none)")
    add(
        "--uplink-interval",
        metavar="S",
        type=float,
        default=1.0,
        help="seconds between two transmissions (default: %(default)s)",
    )
    add("--spool", metavar="FILE", type=Path, help="store unsent data here, across restarts (default: in memory)")
    add(
        "--team-map",
        choices=[NONE, "vote", "refined"],
        default=NONE,
        help="insert teammates' voxels of the task's region, voted or refined (default: %(default)s)",
    )
    add_switch(
        group,
        "--free-space",
        "send what the camera has observed as free: it shows frames that do not fit (default: --free-space)",
        default=True,
    )
    add_switch(group, "--handover", "at the end also send the map outside the ROI")
    keyframes = add(
        "--keyframes",
        metavar="N",
        type=Number("keyframes", int, 0, _MAX_KEYFRAMES),
        help=f"send up to N keyframes for the refinement while mapping (default: {_KEYFRAMES} with --handover, else 0)",
    )
    set_dependent_default(keyframes, _default_keyframes)
    add(
        "--drain-timeout",
        metavar="S",
        type=Number("drain-timeout", float, 0, MAX_DRAIN_S),
        default=120.0,
        help="longest wait for the transmission at the end of a mission, in seconds (default: %(default)s)",
    )
    add(
        "--grace-period",
        metavar="S",
        type=Number("grace-period", float, 0, MAX_DRAIN_S),
        default=5.0,
        help="longest wait for the transmission after SIGTERM, in seconds (default: %(default)s)",
    )


def _add_load(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("load").add_argument
    add("--queue", metavar="N", type=int, default=4, help="length of the frame queue (default: %(default)s)")
    add(
        "--queue-policy",
        choices=[str(each) for each in QueuePolicy],
        default=str(QueuePolicy.OLDEST),
        help="frame that a full queue drops (default: %(default)s)",
    )
    idle = add(
        "--idle-iterations",
        metavar="N",
        type=int,
        help=f"training iterations while the queue is empty (default: {_IDLE_ITERATIONS} at --rate, else 0)",
    )
    set_dependent_default(idle, _default_idle_iterations)
