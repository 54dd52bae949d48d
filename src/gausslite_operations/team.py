"""The commands for a running team: status, refine, fetch, evict, unban, end."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from typing import Any

from gausslite.cli.progress import progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.command_parser import CommandParser, bounded
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.config.values import read_path
from gausslite.domain.checks import require_identifier
from gausslite.domain.errors import MismatchError
from gausslite.mission.results import MAP_FILE, prepare_file
from gausslite.process import ROBOT_LOST, TASK_NOT_FOUND, size_text
from gausslite.wire.channel import is_agent, require_callable
from gausslite.wire.clients import AgentClient, Export, FusionClient
from gausslite.wire.convert import message_to_values
from gausslite.wire.security import TlsFiles


def add_address(parser: CommandParser, service: str) -> None:
    """Add ADDRESS and the options of encrypted connections."""
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH", help=f"address of {service}")
    add_flags(parser, TlsFiles)


def fusion_client(options: argparse.Namespace) -> FusionClient:
    """Return a client of the fusion server at the address. Raises InvalidInputError."""
    require_callable("address of the fusion server", options.address)
    return FusionClient(options.address, tls=build(TlsFiles, options).read())


def agent_client(options: argparse.Namespace) -> AgentClient:
    """Return a client of the agent at the address. Raises InvalidInputError."""
    require_callable("address of the agent", options.address)
    return AgentClient(options.address, tls=build(TlsFiles, options).read())


_MAX_DRAIN_S = 86_400.0


def configure_end(parser: CommandParser) -> None:
    """Add the options of `gausslite end`."""
    add_address(parser, "the agent")
    parser.add_argument(
        "--handover",
        action="store_true",
        help="also send the map outside the task's region (default: as the agent's option)",
    )
    parser.add_argument(
        "--drain-timeout",
        metavar="S",
        type=bounded(float, 0, _MAX_DRAIN_S),
        help="longest time for sending, in seconds (default: the agent's)",
    )
    parser.set_defaults(run=run_end, handover=None)


def run_end(options: argparse.Namespace) -> int:
    """End the mission and print what was sent and left. Returns 1 if something was left. Raises GaussLiteError."""
    with agent_client(options) as client:
        response = client.end_mission(options.handover, options.drain_timeout)
    print(response.summary)
    return 1 if response.voxels_waiting or response.keyframes_waiting else 0


def configure_evict(parser: CommandParser) -> None:
    """Add the options of `gausslite evict`."""
    add_address(parser, "the fusion server")
    parser.add_argument("agent", metavar="AGENT", help="id of the agent, as `gausslite status` prints it")
    parser.add_argument("--ban", action="store_true", help="also refuse later joins under this id")
    parser.set_defaults(run=run_evict)


def run_evict(options: argparse.Namespace) -> int:
    """End the agent's session, delete its data and print how much that was. Returns the exit code.

    Raises InvalidInputError for an unknown agent, NotPermittedError unless the caller is an operator, UnavailableError.
    """
    require_identifier("AGENT", options.agent)
    with fusion_client(options) as client:
        voxels = client.evict(options.agent, options.ban)
    print(f"{'banned' if options.ban else 'evicted'} {options.agent}: data of {voxels} voxels deleted")
    return 0


def configure_unban(parser: CommandParser) -> None:
    """Add the options of `gausslite unban`."""
    add_address(parser, "the fusion server")
    parser.add_argument("agent", metavar="AGENT", help="id of the banned agent, as `gausslite status` prints it")
    parser.set_defaults(run=run_unban)


def run_unban(options: argparse.Namespace) -> int:
    """Lift the ban. Returns the exit code. Raises InvalidInputError if there is none, NotPermittedError."""
    require_identifier("AGENT", options.agent)
    with fusion_client(options) as client:
        client.unban(options.agent)
    print(f"{options.agent} may join again")
    return 0


_EMPTY, _HEADER_BYTES = b"\nelement vertex 0\n", 1 << 12
_STRATEGIES = ("vote", "refined", "concatenation")


def configure_fetch(parser: CommandParser) -> None:
    """Add the options of `gausslite fetch`."""
    add_address(parser, "the fusion server")
    add = parser.add_argument
    add("--out", metavar="FILE.ply", type=read_path, required=True, help="the file to write")
    add(
        "--strategy",
        choices=_STRATEGIES,
        default=_STRATEGIES[0],
        help="the winner of each voxel, the latest refinement, or all agents' Gaussians (default: %(default)s)",
    )
    add("--agent", metavar="NAME", default="", help="only this agent's Gaussians (default: all agents')")
    parser.set_defaults(run=run_fetch)


def run_fetch(options: argparse.Namespace) -> int:
    """Download the map. Returns the exit code. Raises MismatchError before the first refinement, UnavailableError."""
    prepare_file(options.out, MAP_FILE)
    with fusion_client(options) as client:
        data = client.export(Export(options.strategy, options.agent))
    if _EMPTY in data[:_HEADER_BYTES]:
        whose = f"agent {options.agent}" if options.agent else "any agent"
        raise MismatchError(f"{options.address}: the map is empty: the server has no Gaussians of {whose}")
    write_atomic(options.out, data)
    print(f"wrote {options.out}, {size_text(len(data))}")
    return 0


_MAX_ITERATIONS, _MAX_SEED = 1_000_000, (1 << 63) - 1


def configure_refine(parser: CommandParser) -> None:
    """Add the options of `gausslite refine`."""
    add_address(parser, "the fusion server")
    add = parser.add_argument
    add(
        "--iterations",
        metavar="N",
        type=bounded(int, 1, _MAX_ITERATIONS),
        default=0,
        help="most training iterations (default: the server's)",
    )
    add(
        "--seed",
        metavar="N",
        type=bounded(int, 0, _MAX_SEED),
        default=0,
        help="seed of the random views (default: %(default)s)",
    )
    add("--out", metavar="FILE.ply", type=read_path, help="also download the refined map to this file")
    parser.set_defaults(run=run_refine)


def run_refine(options: argparse.Namespace) -> int:
    """Refine the map, and show the progress. Ctrl-C cancels the refinement. Returns the exit code.

    Raises MismatchError without a map and keyframes, QuotaError while another refinement runs, UnavailableError.
    """
    if options.out is not None:
        prepare_file(options.out, MAP_FILE)
    gaussians, left_out = 0, list[str]()
    with fusion_client(options) as client:
        with progress_bar(options.iterations, "refine", "it") as bar:
            for progress in client.refine(options.iterations, seed=options.seed):
                bar.total, gaussians, left_out = progress.iterations, progress.gaussians, list(progress.left_out)
                bar.set_postfix_str(f"loss {progress.loss:.4f}", refresh=False)
                bar.update(progress.iteration - bar.n)
        for line in left_out:
            print(f"left out, because they disagree with the vote: {line}")
        print(f"refined {gaussians:,} Gaussians")
        if options.out is not None:
            write_atomic(options.out, client.export(Export("refined")))
            print(f"wrote {options.out}")
        else:
            print(f"get it with: gausslite fetch {options.address} --strategy refined --out refined.ply")
    return 0


_STATE_PREFIX = "AGENT_STATE_"


def configure_status(parser: CommandParser) -> None:
    """Add the options of `gausslite status`."""
    add_address(parser, "an agent or a fusion server")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_status)


def run_status(options: argparse.Namespace) -> int:
    """Print the status. Returns 3 if an agent has not seen its task. Raises UnavailableError, InvalidInputError."""
    tls = build(TlsFiles, options).read()
    of_agent = is_agent(options.address, tls)
    with (AgentClient if of_agent else FusionClient)(options.address, tls=tls) as client:
        values = message_to_values(client.status())
    if options.json:
        print(json.dumps(values))
    else:
        print("\n".join((_agent_lines if of_agent else _fusion_lines)(values)))
    if of_agent and values["localisation"] == "LOCALISATION_LOST":
        return ROBOT_LOST
    has_searched = of_agent and "graph" in values and int(values["frames_mapped"]) > 0
    return TASK_NOT_FOUND if has_searched and values["roi_share"] == 0 else 0


def _place(robot: Mapping[str, Any]) -> str:
    """Return a remark on a robot whose place is not known; empty for others."""
    place = robot["localisation"].removeprefix("LOCALISATION_").lower()
    return f"; the robot is {place}" if place in ("doubtful", "lost") else ""


def _agent_lines(status: Mapping[str, Any]) -> Iterator[str]:
    state = status["state"].removeprefix(_STATE_PREFIX).replace("_", " ").lower()
    yield f"agent {status['agent_id']}: {state}{_place(status)}"
    if "graph" in status:
        yield f"task       {status['graph']['text']}"
    yield (
        f"frames     {status['frames_mapped']} mapped at {status['hz']:.2f} Hz, {status['frames_skipped']} skipped, "
        f"{status['frames_dropped']} dropped, {status['frames_rejected']} rejected"
    )
    roi_percent = 100 * status["roi_share"]
    yield f"map        {_count(status['gaussians'])} Gaussians, {roi_percent:.1f} % of the pixels in the task's region"
    if "uplink" in status:
        yield from _uplink_lines(status["uplink"])
    for note in status["notes"]:
        yield f"note       {note}"


def _count(value: str) -> str:
    """Return a 64-bit integer, which is text in the JSON of a message, with separated thousands."""
    return f"{int(value):,}"


def _size(value: str) -> str:
    return size_text(int(value))


def _uplink_lines(uplink: Mapping[str, Any]) -> Iterator[str]:
    connection = "connected" if uplink["connected"] else uplink["stopped_because"] or "not connected"
    yield (
        f"uplink     {connection}; sent {_count(uplink['voxels_sent'])} voxels ({_size(uplink['bytes_sent'])}) and "
        f"{uplink['keyframes_sent']} keyframes ({_size(uplink['keyframe_bytes'])})"
    )
    yield f"waiting    {uplink['voxels_waiting']} voxels, {uplink['keyframes_waiting']} keyframes"


def _frame_line(alignment: Mapping[str, Any]) -> str:
    state = alignment["state"].removeprefix("ALIGNMENT_STATE_").lower().replace("unspecified", "not compared")
    reason = alignment["message"].removeprefix("frame: ")
    return f"frame {state}{': ' if reason else ''}{reason}"


def _last_contact(last_seen_ns: int) -> str:
    """Return the age of an agent's last message, by the clocks of the server and of this machine."""
    if not last_seen_ns:
        return "not heard since the server's start"
    return f"heard {max(0, time.time_ns() - last_seen_ns) // 10**9} s ago"


def _fusion_lines(status: Mapping[str, Any]) -> Iterator[str]:
    yield f"fusion server, mission {status['mission_id'] or '(no agent has joined yet)'}"
    yield f"fused map  {_count(status['fused_gaussians'])} Gaussians in {_count(status['fused_voxels'])} voxels"
    yield f"keyframes  {status['keyframes']}; {'refined' if status['refined'] else 'not refined yet'}"
    for agent in status["agents"]:
        state = "joined" if agent["joined"] else "absent"
        state += f", {_last_contact(int(agent['last_seen_ns']))}{_place(agent)}"
        yield (
            f"{agent['agent_id']:10} {state}; {_count(agent['gaussians'])} Gaussians, "
            f"wins {_count(agent['won_voxels'])} of {_count(agent['voxels'])} voxels, {agent['keyframes']} keyframes; "
            f"received since the server's start: {_size(agent['roi_bytes'])} of the region, "
            f"{_size(agent['handover_bytes'])} of handovers"
        )
        yield f"           {_frame_line(agent['alignment'])}"
    if status["banned_agents"]:
        yield f"banned     {', '.join(status['banned_agents'])}"
