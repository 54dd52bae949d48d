"""What a joint refinement begins with: the vote, and the team's keyframes in its frame."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import AgentKeyframe

_MAX_PIXELS = 64 * 1920 * 1080
"""Of the keyframes of a refinement, which are in memory while it runs."""


@dataclass(frozen=True, slots=True, eq=False)
class RefineInput:
    """The vote at a revision, and the team's keyframes in its frame.

    regions: the voxels of its task's region that each agent wins; agents that win others only have an entry without.
    """

    gaussians: Gaussians
    keyframes: Sequence[AgentKeyframe]
    regions: Mapping[str, Int64[ndarray, " k"]]
    grid: VoxelGrid
    revision: int

    @classmethod
    def of(cls, engine: FusionEngine) -> RefineInput:
        """Return an engine's fused map and the agents' keyframes. Raises MismatchError if one is empty."""
        # before the map is read: what changes meanwhile counts as changed
        revision, (voted, regions) = engine.maps.revision(), engine.maps.voted_regions()
        pixels = engine.keyframes.pixels()
        if not pixels or len(voted.gaussians) == 0:
            raise MismatchError(
                f"refinement: expected a fused map and keyframes, got {len(voted.gaussians)} Gaussians and "
                f"{len(pixels)} keyframes; agents send keyframes with handover = true"
            )
        keyframes = list(engine.decoded_keyframes(within_memory(pixels)))
        return cls(voted.gaussians, keyframes, regions, engine.grid, revision)


def within_memory(pixels: Mapping[tuple[str, int], int]) -> list[tuple[str, int]]:
    """Return the names of the keyframes that fit into memory: all, or the same share of each agent's, and one at least.

    pixels: of each keyframe, sorted by name.
    """
    by_agent = [list(own) for _, own in itertools.groupby(pixels, lambda name: name[0])]
    total = sum(len(own) * max(pixels[name] for name in own) for own in by_agent)
    return [name for own in by_agent for name in evenly(own, len(own) * _MAX_PIXELS // max(total, _MAX_PIXELS))]


def evenly(names: Sequence[tuple[str, int]], most: int) -> list[tuple[str, int]]:
    """Return at most so many of an agent's keyframes, but one at least, evenly over its mission."""
    count = min(max(1, most), len(names))
    return [names[len(names) * i // count] for i in range(count)]
