"""The objects seen so far, in world coordinates: several sightings of one thing become one entry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

_MIN_REACH_M: Final = 0.15
_MAX_OBJECTS: Final = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One object in one frame: its centroid in the world and the radius that holds most of its visible points."""

    phrase: str
    centroid_m: Float64[ndarray, "3"]
    radius_m: float


@dataclass(slots=True, eq=False)
class Remembered:
    """One object over all its sightings: the mean centroid, the largest radius, how often it was seen."""

    sighting: Sighting
    seen: int = 1

    @property
    def phrase(self) -> str:
        """The noun phrase it answers."""
        return self.sighting.phrase

    @property
    def centroid_m(self) -> Float64[ndarray, "3"]:
        """Where it is on average."""
        return self.sighting.centroid_m

    def is_same_object(self, other: Sighting) -> bool:
        """True when a sighting is so near that it must be this object, whatever it was called."""
        reach_m = max(_MIN_REACH_M, 0.75 * min(self.sighting.radius_m, other.radius_m))
        return float(np.linalg.norm(self.centroid_m - other.centroid_m)) < reach_m

    def add(self, other: Sighting) -> None:
        """Take one more sighting into the mean."""
        self.seen += 1
        centroid = self.centroid_m + (other.centroid_m - self.centroid_m) / self.seen
        self.sighting = Sighting(self.phrase, centroid, max(self.sighting.radius_m, other.radius_m))


class ObjectMemory:
    """Everything a task's nouns have named so far; bounded, the least seen goes first."""

    def __init__(self) -> None:
        self._objects: list[Remembered] = []

    @property
    def objects(self) -> tuple[Remembered, ...]:
        """All entries, oldest first."""
        return tuple(self._objects)

    def named(self, phrase: str) -> list[Remembered]:
        """The objects that answer a phrase."""
        return [each for each in self._objects if each.phrase == phrase]

    def confirmed(self, phrase: str) -> list[Remembered]:
        """Those seen at least twice, or all while none was: a single false detection does not become the answer."""
        candidates = self.named(phrase)
        return [each for each in candidates if each.seen > 1] or candidates

    def observe(self, sightings: Sequence[Sighting]) -> None:
        """Add one frame's sightings to the nearest entries of the same phrase, or as new entries."""
        for sighting in sightings:
            same = [each for each in self.named(sighting.phrase) if each.is_same_object(sighting)]
            if same:
                min(same, key=lambda each: float(np.linalg.norm(each.centroid_m - sighting.centroid_m))).add(sighting)
            else:
                self._objects.append(Remembered(sighting))
        if len(self._objects) > _MAX_OBJECTS:
            rarest = min(range(len(self._objects)), key=lambda index: self._objects[index].seen)
            del self._objects[rarest]
