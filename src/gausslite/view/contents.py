"""What the page shows at one moment: a map with the agent of each Gaussian, objects, trajectory and keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.codec.keyframe_views import KeyframeView
from gausslite.domain.arrays import require_array
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark

NO_AGENT = -1


@dataclass(frozen=True, slots=True)
class AgentPath:
    """The keyframes of one agent of a team, oldest first, in the fused map's frame. colour_index: of the agent."""

    agent: str
    colour_index: int
    keyframes: tuple[KeyframeView, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ViewContents:
    """A map and what belongs to it.

    agent: for each Gaussian an index into agents, NO_AGENT if unknown. targets: noun phrases by Gaussians.target; empty
    for a map of several tasks. T_world_camera: the trajectory, in time order. times_ns: its capture times. paths: those
    of a team's agents. state_ns: the time of this state; without it the trajectory's end.
    """

    gaussians: Gaussians
    agent: Int64[ndarray, " n"]
    agents: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    objects: tuple[ObjectLandmark, ...] = ()
    times_ns: Int64[ndarray, " t"] = field(default_factory=lambda: np.zeros(0, np.int64))
    T_world_camera: Float64[ndarray, "t 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    keyframes: Sequence[KeyframeView] = ()
    paths: tuple[AgentPath, ...] = ()
    state_ns: int | None = None

    def __post_init__(self) -> None:
        require_array("agent", self.agent, (len(self.gaussians),), np.int64)
        require_array("times_ns", self.times_ns, (None,), np.int64)
        require_array("T_world_camera", self.T_world_camera, (len(self.times_ns), 4, 4), np.float64)

    @property
    def newest_ns(self) -> int | None:
        """The time of this state; None if it is unknown."""
        if self.state_ns is not None:
            return self.state_ns
        return int(self.times_ns[-1]) if len(self.times_ns) else None

    @classmethod
    def of_one_agent(cls, gaussians: Gaussians, agent_id: str = "") -> ViewContents:
        """Return the map of one agent; without a name its Gaussians have no agent."""
        index, agents = (0, (agent_id,)) if agent_id else (NO_AGENT, ())
        return cls(gaussians, np.full(len(gaussians), index, np.int64), agents)
