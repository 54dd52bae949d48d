"""The views that agents leave with the team for the joint refinement: a bounded buffer of each agent's newest."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.errors import InvalidInputError, QuotaError


@dataclass(frozen=True, slots=True, eq=False)
class AgentKeyframe:
    """A view of one agent; weight in [0, 1] says what of it matters (None = all of it)."""

    agent_id: str
    frame: Frame
    weight: Float32[ndarray, "h w"] | None = None


class KeyframePool:
    """Per agent the `max_per_agent` frames with the highest index; an index that comes again replaces the older one.

    Memory is bounded by agents × max_per_agent × max_pixels × 7 bytes. Not safe for threads: the mission's lock is.
    """

    def __init__(self, max_per_agent: int, max_pixels: int) -> None:
        if max_per_agent < 1 or max_pixels < 1:
            raise InvalidInputError(
                f"keyframe pool: expected limits of at least 1, got {max_per_agent} frames of {max_pixels} pixels"
            )
        self._max_per_agent = max_per_agent
        self._max_pixels = max_pixels
        self._by_agent: dict[str, dict[int, AgentKeyframe]] = {}

    def __len__(self) -> int:
        return sum(len(frames) for frames in self._by_agent.values())

    def add(self, keyframe: AgentKeyframe) -> None:
        """Keep the view, dropping the agent's oldest when full. Raises QuotaError for an image that is too large."""
        pixels = keyframe.frame.depth_m.size
        if pixels > self._max_pixels:
            raise QuotaError(
                f"keyframe {keyframe.frame.index}: expected at most {self._max_pixels} pixels, got {pixels}"
            )
        frames = self._by_agent.setdefault(keyframe.agent_id, {})
        frames[keyframe.frame.index] = keyframe
        if len(frames) > self._max_per_agent:
            del frames[min(frames)]

    def count(self, agent_id: str) -> int:
        """How many views of this agent are held."""
        return len(self._by_agent.get(agent_id, {}))

    def remove_agent(self, agent_id: str) -> None:
        """Forget an agent's views."""
        self._by_agent.pop(agent_id, None)

    def keyframes(self) -> list[AgentKeyframe]:
        """The union of the agents' buffers, by agent id and frame index."""
        return [
            frames[index]
            for agent_id in sorted(self._by_agent)
            for frames in [self._by_agent[agent_id]]
            for index in sorted(frames)
        ]
