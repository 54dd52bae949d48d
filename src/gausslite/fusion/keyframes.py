"""Keep each agent's newest keyframes for the joint refinement."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.frame import Frame


@dataclass(frozen=True, slots=True, eq=False)
class AgentKeyframe:
    """A keyframe of one agent. pixel_weights: the weight of each pixel in the loss, 0 to 1; None means 1 everywhere."""

    agent_id: str
    frame: Frame
    pixel_weights: Float32[ndarray, "h w"] | None = None


class KeyframePool:
    """Keeps the `max_per_agent` frames of each agent with the highest index; a repeated index replaces the earlier one.

    Memory per agent is at most max_per_agent × max_pixels × 11 bytes: RGB 3, depth 4, pixel weight 4. Not thread-safe;
    FusionEngine holds a lock.
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
        """Add the keyframe and remove the agent's oldest above the limit. Raises QuotaError for too many pixels."""
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
        """Return the number of keyframes of this agent."""
        return len(self._by_agent.get(agent_id, {}))

    def remove_agent(self, agent_id: str) -> None:
        """Delete an agent's keyframes."""
        self._by_agent.pop(agent_id, None)

    def keyframes(self) -> list[AgentKeyframe]:
        """Return all agents' keyframes, sorted by agent id and frame index."""
        return [
            frames[index]
            for agent_id in sorted(self._by_agent)
            for frames in [self._by_agent[agent_id]]
            for index in sorted(frames)
        ]
