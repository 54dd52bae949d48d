"""The figures of a mission and of its agents: messages, stored data, voxels won."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

from gausslite.fusion.frame_alignment import FrameAlignment
from gausslite.fusion.mission_config import MissionConfig


@dataclass(frozen=True, slots=True)
class TrafficCounters:
    """Messages of one agent since the server started. last_seen_ns: time of its latest subset, 0 before the first."""

    last_seen_ns: int = 0
    roi_bytes: int = 0
    handover_bytes: int = 0
    subsets_accepted: int = 0
    subsets_stale: int = 0
    subsets_rejected: int = 0

    def plus(self, newer: TrafficCounters) -> TrafficCounters:
        """Return the sums, with last_seen_ns of the newer counters."""
        return TrafficCounters(
            newer.last_seen_ns,
            self.roi_bytes + newer.roi_bytes,
            self.handover_bytes + newer.handover_bytes,
            self.subsets_accepted + newer.subsets_accepted,
            self.subsets_stale + newer.subsets_stale,
            self.subsets_rejected + newer.subsets_rejected,
        )


class TrafficLog:
    """The counters of each agent. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self) -> None:
        self._by_agent: dict[str, TrafficCounters] = {}

    def record(self, agent_id: str, traffic: TrafficCounters) -> None:
        """Add to the agent's counters, and set its last_seen_ns to now."""
        newer = replace(traffic, last_seen_ns=time.time_ns())
        self._by_agent[agent_id] = self.of(agent_id).plus(newer)

    def of(self, agent_id: str) -> TrafficCounters:
        """Return the agent's counters; zero for an unknown agent."""
        return self._by_agent.get(agent_id, TrafficCounters())

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent."""
        self._by_agent.pop(agent_id, None)


@dataclass(frozen=True, slots=True)
class AgentContribution:
    """Stored data of one agent, the number of voxels that it wins, its task's targets, its frame and its traffic."""

    agent_id: str
    joined: bool = False
    voxels: int = 0
    gaussians: int = 0
    kappa_sum: int = 0
    won_voxels: int = 0
    last_update_seq: int = 0
    keyframes: int = 0
    targets: tuple[str, ...] = ()
    free_voxels: int = 0
    alignment: FrameAlignment = field(default_factory=lambda: FrameAlignment(0))
    traffic: TrafficCounters = field(default_factory=TrafficCounters)


@dataclass(frozen=True, slots=True)
class MissionStatus:
    """The figures of a mission and of each agent."""

    mission_config: MissionConfig
    revision: int
    fused_gaussians: int
    fused_voxels: int
    keyframes: int
    refined: bool
    agents: tuple[AgentContribution, ...]
    banned_agents: tuple[str, ...] = ()
