"""An exact detector over named ground-truth regions, for simulations and evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import MatchBasis, NounMatch
from gausslite.domain.object_names import meant_by
from gausslite.domain.region import Region
from gausslite.domain.relevance import Detection
from gausslite.perception.detect import bounding_box


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
                box = bounding_box(masks[name])
                if box is not None:
                    found.append(Detection(query, 1.0, box, masks[name]))
        return found

    def _names(self, query: str) -> tuple[str, ...]:
        return meant_by(query, self._regions)
