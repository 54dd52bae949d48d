"""Relevance estimators without a task sentence: given regions, or no region at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import NounReport
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.region import Region
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.domain.state import State
from gausslite.perception.relevance_estimator import RelevanceEstimate


class RegionRelevanceEstimator:
    """A RelevanceEstimator that marks given regions; region i is target i, and the first wins in an overlap."""

    def __init__(self, regions: Sequence[Region]) -> None:
        if not regions:
            raise InvalidInputError("regions: expected at least one region, got none")
        self._regions = tuple(regions)

    @property
    def notes(self) -> tuple[str, ...]:
        """Empty: no detection can fail."""
        return ()

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 1 on every pixel that shows a region; the rendered depth is not needed."""
        del rendered_depth_m
        target = np.full(frame.depth_m.shape, NO_TARGET, np.int16)
        for index, region in reversed(list(enumerate(self._regions))):
            target[region.mask(frame)] = index
        return RelevanceEstimate(RelevanceMap((target != NO_TARGET).astype(np.float32), target))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """Return the relevance as `estimate` does."""
        return self.estimate(frame).relevance

    @property
    def known_objects(self) -> int:
        """Always 0: nothing becomes known during a mission."""
        return 0

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return the relevance."""
        del frame
        return relevance

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """Empty: there is no object map."""
        return ()

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """Empty: there is no detector."""
        return ()

    def state(self) -> State:
        """Return nothing: each frame's relevance is independent of the others."""
        return {}

    def restore(self, state: State) -> None:
        """Do nothing: there is no state."""
        del state


class NoTaskEstimator:
    """A RelevanceEstimator for uniform maps: no pixel is relevant."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Empty: no detection can fail."""
        return ()

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return weight 0 everywhere."""
        del rendered_depth_m
        return RelevanceEstimate(RelevanceMap.empty(*frame.depth_m.shape))

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """Return the relevance as `estimate` does."""
        return self.estimate(frame).relevance

    @property
    def known_objects(self) -> int:
        """Always 0: nothing becomes known during a mission."""
        return 0

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return the relevance."""
        del frame
        return relevance

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """Empty: there is no object map."""
        return ()

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """Empty: there is no detector."""
        return ()

    def state(self) -> State:
        """Return nothing: each frame's relevance is independent of the others."""
        return {}

    def restore(self, state: State) -> None:
        """Do nothing: there is no state."""
        del state
