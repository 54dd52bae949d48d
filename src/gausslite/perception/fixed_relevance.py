"""RelevanceEstimator without words: the task's region is given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.region import Region
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.domain.state import State
from gausslite.errors import InvalidInputError
from gausslite.perception.relevance_estimator import RelevanceEstimate


class RegionRelevanceEstimator:
    """An RelevanceEstimator that marks the given regions; region i is target i, earlier ones win where they overlap."""

    def __init__(self, regions: Sequence[Region]) -> None:
        if not regions:
            raise InvalidInputError("regions: expected at least one region, got none")
        self._regions = tuple(regions)

    @property
    def notes(self) -> tuple[str, ...]:
        """None: nothing has to be found."""
        return ()

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Weight 1 on every pixel that shows a region; masks are exact without the rendered depth."""
        del rendered_depth_m
        target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
        for index, region in reversed(list(enumerate(self._regions))):
            target[region.mask(frame)] = index
        return RelevanceEstimate(RelevanceMap((target != NO_TARGET).astype(np.float32), target))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """As for any other frame."""
        return self.estimate(frame).relevance

    def state(self) -> State:
        """Nothing: every frame is judged by itself."""
        return {}

    def restore(self, state: State) -> None:
        """Nothing to take over."""
        del state


class NoTaskEstimator:
    """An RelevanceEstimator for uniform maps: nothing is relevant."""

    @property
    def notes(self) -> tuple[str, ...]:
        """None: nothing has to be found."""
        return ()

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Weight 0 everywhere."""
        del rendered_depth_m
        return RelevanceEstimate(RelevanceMap.empty(*frame.depth_m.shape))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """As for any other frame."""
        return self.estimate(frame).relevance

    def state(self) -> State:
        """Nothing: every frame is judged by itself."""
        return {}

    def restore(self, state: State) -> None:
        """Nothing to take over."""
        del state
