"""Encode the figures of a mission as messages."""

from __future__ import annotations

from gausslite.fusion.traffic import AgentContribution
from gausslite.v1 import fusion_service_pb2 as pb


def contribution_to_message(agent: AgentContribution) -> pb.AgentContribution:
    """Encode the figures of one agent."""
    return pb.AgentContribution(
        agent_id=agent.agent_id,
        joined=agent.joined,
        gaussians=agent.gaussians,
        voxels=agent.voxels,
        won_voxels=agent.won_voxels,
        roi_bytes=agent.traffic.roi_bytes,
        handover_bytes=agent.traffic.handover_bytes,
        subsets_accepted=agent.traffic.subsets_accepted,
        subsets_stale=agent.traffic.subsets_stale,
        subsets_rejected=agent.traffic.subsets_rejected,
        keyframes=agent.keyframes,
        kappa_sum=agent.kappa_sum,
        last_update_seq=agent.last_update_seq,
        last_seen_ns=agent.traffic.last_seen_ns,
        targets=agent.targets,
    )
