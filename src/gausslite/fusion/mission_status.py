"""Collect the figures of a mission and of each agent."""

from __future__ import annotations

from gausslite.fusion.mission_data import MissionData
from gausslite.fusion.store import FusionStore
from gausslite.fusion.traffic import AgentContribution, MissionStatus


def mission_status(store: FusionStore, mission: MissionData) -> MissionStatus:
    """Return the totals of the mission and of each agent. Call it with the engine's lock."""
    fused_voxels, fused_gaussians = mission.maps.size()
    return MissionStatus(
        mission_config=mission.members.mission_config,
        revision=mission.maps.revision(),
        fused_gaussians=fused_gaussians,
        fused_voxels=fused_voxels,
        keyframes=len(mission.keyframes),
        refined=mission.maps.is_refined,
        agents=tuple(_contribution(store, mission, agent_id) for agent_id in sorted(mission.members.sources)),
        banned_agents=mission.members.banned,
    )


def _contribution(store: FusionStore, mission: MissionData, agent_id: str) -> AgentContribution:
    totals = store.totals(agent_id)
    return AgentContribution(
        agent_id,
        joined=agent_id in mission.members.joined,
        voxels=totals.occupied_voxels,
        gaussians=totals.gaussians,
        kappa_sum=totals.kappa_sum,
        won_voxels=mission.maps.won_voxels(agent_id),
        last_update_seq=totals.highest_update_seq,
        keyframes=mission.keyframes.count(agent_id),
        targets=mission.objects.targets(agent_id),
        free_voxels=mission.free_space.free_voxels(agent_id),
        alignment=mission.alignments.get(agent_id),
        traffic=mission.traffic.of(agent_id),
    )
