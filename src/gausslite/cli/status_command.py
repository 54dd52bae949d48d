"""`gausslite status`: print the state of a running agent or fusion server."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from typing import Any

from gausslite.cli.team_options import add_address, add_json
from gausslite.config.option import build
from gausslite.wire.service_status import query_status
from gausslite.wire.tls import TlsFiles

_STATE_PREFIX = "AGENT_STATE_"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite status`."""
    add_address(parser, "an agent or a fusion server")
    add_json(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the status. Returns the exit code. Raises UnavailableError, InvalidInputError."""
    status = query_status(options.address, build(TlsFiles, options).read())
    if options.json:
        print(json.dumps(status.values))
    else:
        print("\n".join((_agent_lines if status.is_agent else _fusion_lines)(status.values)))
    return 0


def _agent_lines(status: Mapping[str, Any]) -> Iterator[str]:
    state = status["state"].removeprefix(_STATE_PREFIX).replace("_", " ").lower()
    yield f"agent {status['agent_id']}: {state}"
    if "graph" in status:
        yield f"task       {status['graph']['text']}"
    yield (
        f"frames     {status['frames_mapped']} mapped at {status['hz']:.2f} Hz, {status['frames_skipped']} skipped, "
        f"{status['frames_dropped']} dropped, {status['frames_rejected']} rejected"
    )
    roi_percent = 100 * status["roi_share"]
    yield f"map        {status['gaussians']} Gaussians, {roi_percent:.1f} % of the pixels in the task's region"
    if "uplink" in status:
        yield from _uplink_lines(status["uplink"])
    for note in status["notes"]:
        yield f"note       {note}"


def _uplink_lines(uplink: Mapping[str, Any]) -> Iterator[str]:
    connection = "connected" if uplink["connected"] else uplink["stopped_because"] or "not connected"
    yield (
        f"uplink     {connection}; sent {uplink['voxels_sent']} voxels ({uplink['bytes_sent']} bytes) and "
        f"{uplink['keyframes_sent']} keyframes ({uplink['keyframe_bytes']} bytes)"
    )
    yield f"waiting    {uplink['voxels_waiting']} voxels, {uplink['keyframes_waiting']} keyframes"


def _fusion_lines(status: Mapping[str, Any]) -> Iterator[str]:
    yield f"fusion server, mission {status['mission_id'] or '(no agent has joined yet)'}"
    yield f"fused map  {status['fused_gaussians']} Gaussians in {status['fused_voxels']} voxels"
    yield f"keyframes  {status['keyframes']}; {'refined' if status['refined'] else 'not refined yet'}"
    for agent in status["agents"]:
        yield (
            f"{agent['agent_id']:10} {'joined' if agent['joined'] else 'absent'}; {agent['gaussians']} Gaussians, "
            f"wins {agent['won_voxels']} of {agent['voxels']} voxels, {agent['keyframes']} keyframes; "
            f"received {agent['roi_bytes']} bytes of the task's region, {agent['handover_bytes']} of handovers"
        )
    if status["banned_agents"]:
        yield f"banned     {', '.join(status['banned_agents'])}"
