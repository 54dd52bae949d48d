"""`gausslite status`: print the state of a running agent or fusion server."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

from google.protobuf.json_format import MessageToDict

from gausslite.cli.team_options import add_address, add_json, agent_client, fusion_client
from gausslite.config.tls_options import read_tls
from gausslite.domain.errors import InvalidInputError
from gausslite.v1.agent_service_pb2 import AgentState, GetAgentStatusResponse
from gausslite.v1.fusion_service_pb2 import GetSessionStatusResponse
from gausslite.wire.health import serves

_AGENT, _FUSION = "gausslite.v1.AgentService", "gausslite.v1.FusionService"
_STATE_PREFIX = "AGENT_STATE_"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite status`."""
    add_address(parser, "an agent or a fusion server")
    add_json(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the status. Returns the exit code. Raises UnavailableError, InvalidInputError."""
    tls = read_tls(options)
    status: GetAgentStatusResponse | GetSessionStatusResponse
    if serves(options.address, _AGENT, tls):
        with agent_client(options) as agent:
            status = agent.status()
        lines = _agent_lines(status)
    elif serves(options.address, _FUSION, tls):
        with fusion_client(options) as fusion:
            status = fusion.status()
        lines = _fusion_lines(status)
    else:
        raise InvalidInputError(f"{options.address}: expected an agent or a fusion server, got another service")
    if options.json:
        print(json.dumps(MessageToDict(status, preserving_proto_field_name=True)))
    else:
        print("\n".join(lines))
    return 0


def _agent_lines(status: GetAgentStatusResponse) -> Iterator[str]:
    state = AgentState.Name(status.state).removeprefix(_STATE_PREFIX).replace("_", " ").lower()
    yield f"agent {status.agent_id}: {state}"
    if status.HasField("graph"):
        yield f"task       {status.graph.text}"
    yield (
        f"frames     {status.frames_mapped} mapped at {status.hz:.2f} Hz, {status.frames_skipped} skipped, "
        f"{status.frames_dropped} dropped, {status.frames_rejected} rejected"
    )
    yield f"map        {status.gaussians} Gaussians, {100 * status.roi_share:.1f} % of the pixels in the task's region"
    uplink = status.uplink
    connection = "connected" if uplink.connected else uplink.stopped_because or "not connected"
    yield (
        f"uplink     {connection}; sent {uplink.voxels_sent} voxels ({uplink.bytes_sent} bytes) and "
        f"{uplink.keyframes_sent} keyframes ({uplink.keyframe_bytes} bytes)"
    )
    yield f"waiting    {uplink.voxels_waiting} voxels, {uplink.keyframes_waiting} keyframes"
    for note in status.notes:
        yield f"note       {note}"


def _fusion_lines(status: GetSessionStatusResponse) -> Iterator[str]:
    yield f"fusion server, mission {status.mission_id or '(no agent has joined yet)'}"
    yield f"fused map  {status.fused_gaussians} Gaussians in {status.fused_voxels} voxels"
    yield f"keyframes  {status.keyframes}; {'refined' if status.refined else 'not refined yet'}"
    for agent in status.agents:
        yield (
            f"{agent.agent_id:10} {'joined' if agent.joined else 'absent'}; {agent.gaussians} Gaussians, "
            f"wins {agent.won_voxels} of {agent.voxels} voxels, {agent.keyframes} keyframes; "
            f"received {agent.roi_bytes} bytes of the task's region, {agent.handover_bytes} of handovers"
        )
