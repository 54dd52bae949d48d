"""Detect the objects that noun phrases name: the protocol, and a detector of ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import Detection, Region
from gausslite.nouns import meant_by


@runtime_checkable
class Detector(Protocol):
    """Detect the objects that noun phrases name, with masks."""

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return all instances of each query, best first; one object may match several queries."""

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what this detector searches for each query."""


def bounding_box(mask: Bool[ndarray, "h w"]) -> tuple[float, float, float, float] | None:
    """Return the tight box (left, top, right, bottom) of a mask in pixels, None if the mask is empty."""
    columns = np.flatnonzero(mask.any(axis=0))
    rows = np.flatnonzero(mask.any(axis=1))
    if len(columns) == 0:
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


class RegionDetector:
    """A Detector over named regions: "mug" finds mug_1 and mug_2, "object" finds every region except structure."""

    def __init__(self, regions: Mapping[str, Region]) -> None:
        self._regions = dict(regions)

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return the regions that match each query."""
        known = tuple(self._regions)
        return tuple(NounMatch(query, MatchBasis.REGION, self._names(query), known=known) for query in queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the visible regions of each query, with score 1 and exact masks."""
        masks = {}
        found = []
        for query in queries:
            for name in self._names(query):
                if name not in masks:
                    masks[name] = self._regions[name].mask(frame)
                if (box := bounding_box(masks[name])) is not None:
                    found.append(Detection(query, 1.0, box, masks[name], is_exact=True, class_name=name))
        return found

    def _names(self, query: str) -> tuple[str, ...]:
        return meant_by(query, self._regions)
