"""The objects seen so far, in world coordinates: partial observations of one thing grow into one entry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.voxels import VoxelGrid

_CELL_GRID: Final = VoxelGrid(0.05)
_MIN_REACH_M: Final = 0.15
_MIN_SHARED: Final = 0.3
_MIN_COUNT_SHARE: Final = 0.15
_MIN_RELIABLE_SHARE: Final = 0.25
_MAX_CELLS: Final = 4000
_MAX_OBJECTS: Final = 500


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One object in one frame: its centroid in the world, the cells of its surface, its radius, who saw it, how surely.

    The radius is twice the median distance of its points to the centroid: masks of chairs let background through, and
    the outermost points would measure that. eye_m is the camera's centre, None where no camera saw it.
    """

    phrase: str
    centroid_m: Float64[ndarray, "3"]
    radius_m: float
    cells: Int64[ndarray, " k"]
    eye_m: Float64[ndarray, "3"] | None = None
    score: float = 1.0

    @classmethod
    def from_points(
        cls,
        phrase: str,
        points_m: Float64[ndarray, "n 3"],
        eye_m: Float64[ndarray, "3"] | None = None,
        score: float = 1.0,
    ) -> Observation:
        """From the points of an object's mask; the centroid is their median, points far outside are left out."""
        centroid = np.median(points_m, axis=0)
        distances = np.linalg.norm(points_m - centroid, axis=1)
        radius_m = 2.0 * float(np.median(distances))
        own = points_m[distances <= 2.0 * max(radius_m, _MIN_REACH_M)]
        return cls(phrase, centroid, radius_m, np.unique(_CELL_GRID.keys(own.astype(np.float32))), eye_m, score)

    @property
    def distance_m(self) -> float:
        """How far from the eye it was; without limit where no camera saw it."""
        return np.inf if self.eye_m is None else float(np.linalg.norm(self.centroid_m - self.eye_m))


@dataclass(slots=True, eq=False)
class Landmark:
    """One object over all its observations. Its centroid is the mean over cells, wherever the camera dwelt.

    missed counts the views that showed its place and not it; farthest_m is the greatest distance it was seen from.
    """

    phrase: str
    centroid_m: Float64[ndarray, "3"]
    radius_m: float
    cells: Int64[ndarray, " k"]
    counts: Int64[ndarray, " k"]
    seen_count: int
    missed_count: int
    best_score: float
    farthest_m: float

    @classmethod
    def from_observation(cls, observation: Observation) -> Landmark:
        """The first observation of an object."""
        counts = np.ones(len(observation.cells), np.int64)
        place = (observation.phrase, observation.centroid_m, observation.radius_m, observation.cells, counts)
        return cls(*place, seen_count=1, missed_count=0, best_score=observation.score, farthest_m=observation.distance_m)

    def is_colocated_with(self, other: Observation) -> bool:
        """True when the centroids are so near that both must be one object, whatever they were called."""
        reach_m = max(_MIN_REACH_M, 0.75 * min(self.radius_m, other.radius_m))
        return float(np.linalg.norm(self.centroid_m - other.centroid_m)) < reach_m

    def matches(self, other: Observation) -> bool:
        """True when a observation of the same phrase shows this object, in whole or in part."""
        shared = len(np.intersect1d(self.cells, other.cells, assume_unique=True))
        return self.is_colocated_with(other) or shared >= _MIN_SHARED * max(1, min(len(self.cells), len(other.cells)))

    def add(self, other: Landmark) -> None:
        """Take another object's observations for this one's, and find its centre anew."""
        self.seen_count += other.seen_count
        self.missed_count += other.missed_count
        self.best_score = max(self.best_score, other.best_score)
        self.farthest_m = max(self.farthest_m, other.farthest_m)
        merged, where = np.unique(np.concatenate([self.cells, other.cells]), return_inverse=True)
        total = np.bincount(where, weights=np.concatenate([self.counts, other.counts])).astype(np.int64)
        if len(merged) > _MAX_CELLS:
            often = np.sort(np.argsort(-total, kind="stable")[:_MAX_CELLS])
            merged, total = merged[often], total[often]
        self.cells, self.counts = merged, total
        centres = self.footprint_m().astype(np.float64)
        self.centroid_m = centres.mean(axis=0)
        self.radius_m = 2.0 * float(np.median(np.linalg.norm(centres - self.centroid_m, axis=1)))

    def footprint_m(self) -> Float32[ndarray, "k 3"]:
        """Centres of the cells seen more than once and not far less often than most, or of all while those are few."""
        firm = self.cells[self.counts > max(1.0, _MIN_COUNT_SHARE * float(np.percentile(self.counts, 90)))]
        return _CELL_GRID.centres_m(firm if len(firm) >= _MIN_RELIABLE_SHARE * len(self.cells) else self.cells)


class ObjectMap:
    """Everything a task's nouns have named so far; bounded, the least seen goes first."""

    def __init__(self, objects: Sequence[Landmark] = ()) -> None:
        """Empty, or with what an earlier memory held, oldest first."""
        self._objects = list(objects)

    @property
    def objects(self) -> tuple[Landmark, ...]:
        """All entries, oldest first."""
        return tuple(self._objects)

    def with_phrase(self, phrase: str) -> list[Landmark]:
        """The objects that answer a phrase."""
        return [each for each in self._objects if each.phrase == phrase]

    def match(self, observation: Observation) -> Landmark | None:
        """The object that a observation shows; None when it was not observed."""
        return next((each for each in self.with_phrase(observation.phrase) if each.matches(observation)), None)

    def observe(
        self, observations: Sequence[Observation], is_visible: Callable[[Landmark], bool] | None = None
    ) -> None:
        """Add one frame's observations to the objects they show; one that joins several makes them one.

        is_visible tells of the other objects which the frame should have shown: these were missed.
        """
        shown = [self._add(observation) for observation in observations]
        if is_visible is not None:
            for each in self._objects:
                if not any(each is other for other in shown):
                    each.missed_count += is_visible(each)
        while len(self._objects) > _MAX_OBJECTS:
            self._objects.remove(min(self._objects, key=lambda each: each.seen_count))

    def _add(self, observation: Observation) -> Landmark:
        new = Landmark.from_observation(observation)
        same = [each for each in self.with_phrase(observation.phrase) if each.matches(observation)]
        if not same:
            self._objects.append(new)
            return new
        same[0].add(new)
        for other in same[1:]:
            same[0].add(other)
            self._objects.remove(other)
        return same[0]
