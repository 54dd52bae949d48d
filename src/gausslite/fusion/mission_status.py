"""Collect the figures of a mission and of each agent."""

from __future__ import annotations

from gausslite.fusion.engine_parts import EngineParts
from gausslite.fusion.store import FusionStore
from gausslite.fusion.traffic import AgentContribution, MissionStatus


def mission_status(store: FusionStore, parts: EngineParts) -> MissionStatus:
    """Return the totals of the mission and of each agent. Call it with the engine's lock."""
    fused_voxels, fused_gaussians = parts.maps.size()
    return MissionStatus(
        parts.members.mission_config,
        parts.maps.revision(),
        fused_gaussians,
        fused_voxels,
        len(parts.keyframes),
        parts.maps.is_refined,
        tuple(_contribution(store, parts, agent_id) for agent_id in sorted(parts.members.sources)),
        parts.members.banned,
    )


def _contribution(store: FusionStore, parts: EngineParts, agent_id: str) -> AgentContribution:
    totals = store.totals(agent_id)
    return AgentContribution(
        agent_id,
        joined=agent_id in parts.members.joined,
        voxels=totals.occupied_voxels,
        gaussians=totals.gaussians,
        kappa_sum=totals.kappa_sum,
        won_voxels=parts.maps.won_voxels(agent_id),
        last_update_seq=totals.highest_update_seq,
        keyframes=parts.keyframes.count(agent_id),
        targets=parts.objects.targets(agent_id),
        free_voxels=parts.free_space.free_voxels(agent_id),
        alignment=parts.alignments.get(agent_id),
        traffic=parts.traffic.of(agent_id),
    )
