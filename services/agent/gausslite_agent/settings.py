"""Settings of the agent, read from its command line, environment and configuration file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build, option
from gausslite.config.program import Program, parse_options
from gausslite.config.values import NONE, VOXEL_SIZE
from gausslite.domain.checks import require_identifier, require_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import UpAxis
from gausslite.domain.task import require_task_text
from gausslite.domain.voxels import VoxelGrid
from gausslite.mission.settings import MissionSettings, PerceptionSettings, PoseMode, SourceSettings
from gausslite.process import print_message
from gausslite.wire.channel import AGENT_ADDRESS, MAX_PORT, require_callable
from gausslite.wire.security import Tls, TlsFiles
from gausslite.wire.update_sender import UplinkSettings
from gausslite_agent.state import MAX_DRAIN_S

_KEYFRAMES = 64
_MAX_KEYFRAMES = 10_000
_IDLE_ITERATIONS = 64
"""The most training iterations after each frame of an agent with a rate, while no other frame waits."""


@dataclass(frozen=True, slots=True)
class LoadSettings:
    """Length of the frame queue, which drops its oldest frame when it is full, and training while it is empty.

    idle_iterations: the most iterations after each frame while no other frame waits. Maps then depend on the clock.
    """

    queue_frames: int = option(4, "length of the frame queue", key="queue", low=1, high=1000)
    idle_iterations: int = 0


def _read_mission(text: str) -> str:
    return require_identifier("mission", text) if text else text


def _keyframes_unless_set(options: argparse.Namespace) -> int:
    """Return 0 without a handover: then only the task's region leaves the robot."""
    return _KEYFRAMES if options.handover else 0


@dataclass(frozen=True, slots=True)
class ConnectionSettings:
    """Connections to the other services.

    spool: None to keep in memory what waits. With keyframes_during_mission, keyframes are sent while mapping, not only
    with a handover.
    """

    parser: str | None = option(
        None,
        "parser service (default: parse tasks in this process, by rules)",
        metavar="ADDRESS",
        convert=partial(require_callable, "parser"),
    )  # None to parse tasks in this process
    fusion: str | None = option(
        None,
        "fusion server (default: none; nothing is sent)",
        metavar="ADDRESS",
        convert=partial(require_callable, "fusion"),
    )  # None to send nothing
    mission_id: str = option(
        "", "mission to join (default: the server's)", key="mission", metavar="ID", convert=_read_mission
    )
    grid: VoxelGrid = option(VoxelGrid(), "edge of the fusion's voxels", **VOXEL_SIZE)
    uplink: UplinkSettings = field(default_factory=UplinkSettings)
    spool: Path | None = option(
        None, "store unsent data here, across restarts (default: in memory)", metavar="FILE", needs="fusion"
    )
    handover: bool = option(False, "at the end also send the map outside the ROI", needs="fusion")
    drain_s: float = option(
        120.0,
        "longest wait for the transmission at the end of a mission",
        key="drain-timeout",
        unit="s",
        low=0,
        high=MAX_DRAIN_S,
    )
    grace_s: float = option(
        5.0, "longest wait for the transmission after SIGTERM", key="grace-period", unit="s", low=0, high=MAX_DRAIN_S
    )
    keyframes: int = option(
        _KEYFRAMES,
        f"send up to N keyframes for the refinement while mapping (default: {_KEYFRAMES} with handover, else 0)",
        low=0,
        high=_MAX_KEYFRAMES,
        needs="fusion",
        computed=_keyframes_unless_set,
    )
    keyframes_during_mission: bool = False
    team_map: str = option(
        NONE,
        "insert teammates' voxels of the task's region, voted or refined",
        choices=(NONE, "vote", "refined"),
        needs="fusion",
    )

    def __post_init__(self) -> None:
        require_name("world-frame", self.uplink.world_frame)


@dataclass(frozen=True, slots=True)
class AgentIdentity:
    """The agent id and voxel size, by which the fusion server identifies a robot's map."""

    agent_id: str
    voxel_size: float


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentSettings:
    """All settings of one agent."""

    listen: str = option(AGENT_ADDRESS, "HOST:PORT or unix:PATH", metavar="ADDRESS")
    agent_id: str = option(
        "agent", "unique name of this agent", metavar="NAME", convert=partial(require_identifier, "agent-id")
    )
    task: str | None = option(None, "the robot's task (default: wait for the AssignTask call)", metavar="TEXT")
    perception: PerceptionSettings
    up_axis: UpAxis | None
    out: Path | None = option(
        None, "folder for map.ply and report.json; replaces earlier ones at the end", metavar="DIR"
    )
    exit_when_done: bool = option(False, "exit after the mission (default: continue to serve)")
    source: SourceSettings | None  # the sequence that replaces the camera, None for frames by IngestFrames
    link: ConnectionSettings
    mission: MissionSettings
    load: LoadSettings
    tls: Tls | None = None
    state: Path | None = option(
        None, "resume the mission saved in this file, and save it here at the end", metavar="FILE"
    )
    prior: Path | None = option(
        None,
        "continue the map of an earlier run, in its world frame: the folder of its results (default: an empty map)",
        metavar="RUN",
    )
    strict: bool = option(False, "end at a frame of the source that cannot be read (default: skip it)")
    save_interval_s: float = option(
        0.0,
        "time between two saves of state during the mission; 0: only at the end",
        key="save-interval",
        unit="s",
        low=0,
        high=MAX_DRAIN_S,
    )
    view: int | None = option(
        None,
        "show the agent on a page at http://127.0.0.1:PORT while the map grows; 0 chooses a port (extra: view)",
        metavar="PORT",
        low=0,
        high=MAX_PORT,
    )

    @property
    def fixed_settings(self) -> tuple[Any, ...]:
        """The settings that must be equal when a saved mission is resumed."""
        return self.mission, AgentIdentity(self.agent_id, self.link.grid.size_m)


PROGRAM = Program.of(
    *(AgentSettings, TlsFiles),
    flags="listen agent-id task source frames size detector parser fusion out state policy poses max-gaussians "
    "iterations rate exit-when-done frame prior",
    defaults={"source": None, "keyframes": None, "save-interval": 60.0},
)


def parse_arguments(arguments: Sequence[str] | None = None) -> AgentSettings:
    """Return the settings of the command line. Raises InvalidInputError."""
    options = parse_options(build_parser(), arguments, warn=print_message)
    if options.source is not None and options.task is None:
        raise InvalidInputError("--task: expected a task for the source, got none")
    if options.task is not None:
        require_task_text(options.task)
    mission = build(MissionSettings, options)
    return build(
        AgentSettings,
        options,
        perception=build(PerceptionSettings, options).at_rate(mission),
        up_axis=options.up,
        source=_source(options, mission),
        link=_connections(options),
        mission=mission,
        # none without a rate, so that maps are reproducible
        load=build(LoadSettings, options, idle_iterations=0 if options.rate is None else _IDLE_ITERATIONS),
        tls=build(TlsFiles, options).read_for_server(),
    )


def _source(options: argparse.Namespace, mission: MissionSettings) -> SourceSettings | None:
    if options.source is None:
        return None
    return build(SourceSettings, options, require_poses=mission.poses is not PoseMode.TRACK)


def _connections(options: argparse.Namespace) -> ConnectionSettings:
    """Return the connections; without a number of keyframes, they are sent at a handover only."""
    is_set = options.keyframes is not None
    link = build(ConnectionSettings, options, keyframes=options.keyframes if is_set else _KEYFRAMES)
    return replace(link, keyframes_during_mission=link.keyframes > 0 if is_set else link.handover)


def build_parser() -> CommandParser:
    """Return the parser of `gausslite-agent`."""
    parser = CommandParser(
        prog="gausslite-agent",
        description="Map the region of interest (ROI) of a task online, and send it to a fusion server. With --source "
        "the agent replays a sequence; otherwise it receives frames by the IngestFrames call.",
    )
    PROGRAM.add_to(parser)
    return parser
