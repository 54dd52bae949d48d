"""Count each agent's part in the team's map, so that nobody's contribution is invisible."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gausslite.fusion.store import MissionConfig, VoxelScoreTable
from gausslite.fusion.vote import VoteResult


@dataclass(frozen=True, slots=True)
class TrafficCounters:
    """What one agent sent in this life of the server. last_seen_ns: when its latest subset came, 0 when none did."""

    last_seen_ns: int = 0
    roi_bytes: int = 0
    handover_bytes: int = 0
    subsets_accepted: int = 0
    subsets_stale: int = 0
    subsets_rejected: int = 0

    def plus(self, sent: TrafficCounters) -> TrafficCounters:
        """Both together, last seen when `sent` was."""
        return TrafficCounters(
            sent.last_seen_ns,
            self.roi_bytes + sent.roi_bytes,
            self.handover_bytes + sent.handover_bytes,
            self.subsets_accepted + sent.subsets_accepted,
            self.subsets_stale + sent.subsets_stale,
            self.subsets_rejected + sent.subsets_rejected,
        )


@dataclass(frozen=True, slots=True)
class AgentContribution:
    """One agent's part: what is held of it, how much of that the fused map shows, and what it sent."""

    agent_id: str
    joined: bool
    voxels: int
    gaussians: int
    kappa_sum: int
    won_voxels: int
    last_map_revision: int
    keyframes: int
    tally: TrafficCounters


@dataclass(frozen=True, slots=True)
class MissionStatus:
    """The state of the mission in figures."""

    mission_config: MissionConfig
    revision: int
    fused_gaussians: int
    fused_voxels: int
    keyframes: int
    refined: bool
    agents: tuple[AgentContribution, ...]


def contribution(agent_id: str, stakes: VoxelScoreTable, election: VoteResult) -> AgentContribution:
    """The part of this agent in the words and in the vote; voxels without Gaussians do not count."""
    none = AgentContribution(agent_id, False, 0, 0, 0, 0, 0, 0, TrafficCounters())
    if agent_id not in stakes.agents:
        return none
    index = stakes.agents.index(agent_id)
    mine = stakes.agent == index
    return replace(
        none,
        voxels=int(np.count_nonzero(stakes.counts[mine])),
        gaussians=int(stakes.counts[mine].sum(dtype=np.int64)),
        kappa_sum=int(stakes.kappa_sums[mine].sum(dtype=np.uint64)),
        won_voxels=int(np.count_nonzero(election.winner == index)),
        last_map_revision=int(stakes.map_revisions[mine].max(initial=0)),
    )
