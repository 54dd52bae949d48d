"""Landmarks: the detected objects in world coordinates, each merged from partial observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.relevance import Rival
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.perception.colours import no_colours
from gausslite.perception.fitted_plane import INNER_PERCENTILES, FittedPlane
from gausslite.perception.surface_votes import SurfaceVotes

_CELL_GRID: Final = VoxelGrid(0.05)
_MIN_MATCH_DISTANCE_M: Final = 0.15
_MAX_SIZE_RATIO: Final = 2.0
_MIN_SHARED: Final = 0.3
_MIN_COUNT_SHARE: Final = 0.15
_MIN_RELIABLE_SHARE: Final = 0.25
_MAX_CELLS: Final = 4000
_MIN_FLAT_WIDTH_M: Final = 0.4
_MAX_FLAT_SLOPE: Final = 0.1
_MAX_OBJECTS: Final = 500
MAX_SUPPORTS: Final = 50


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One object in one frame: centroid in the world, keys of its surface cells, radius, camera centre, score.

    The radius is twice the median distance of the points to the centroid: masks of chairs include background, which
    would dominate the outermost points. camera_m is the camera's centre, None without a camera. time_ns is the frame's
    capture time. rival: a different thing detected in the same place. votes: which voxels the mask
    shows inside and outside the object. colours: `colour_counts` of the mask's pixels.
    supports_m: the levels of planes seen under it, along up in the world. is_weak: of a weak detection.
    plane: fits the mask's points; None for a whole object.
    """

    phrase: str
    centroid_m: Float64[ndarray, "3"]
    radius_m: float
    cells: Int64[ndarray, " k"]
    camera_m: Float64[ndarray, "3"] | None = None
    score: float = 1.0
    time_ns: int = 0
    rival: Rival | None = None
    votes: SurfaceVotes = field(default_factory=SurfaceVotes.empty)
    colours: Float64[ndarray, "balances ranges"] = field(default_factory=no_colours)
    supports_m: Float64[ndarray, " s"] = field(default_factory=lambda: np.zeros(0))
    is_weak: bool = False
    plane: FittedPlane | None = None

    @classmethod
    def from_points(
        cls,
        phrase: str,
        points_m: Float64[ndarray, "n 3"],
        camera_m: Float64[ndarray, "3"] | None = None,
        score: float = 1.0,
        time_ns: int = 0,
    ) -> Observation:
        """Return the observation of a mask's points: their median is the centroid, outliers are dropped."""
        centroid = np.median(points_m, axis=0)
        distances = np.linalg.norm(points_m - centroid, axis=1)
        radius_m = 2.0 * float(np.median(distances))
        inliers = points_m[distances <= 2.0 * max(radius_m, _MIN_MATCH_DISTANCE_M)]
        cells = np.unique(_CELL_GRID.keys(inliers.astype(np.float32)))
        return cls(phrase, centroid, radius_m, cells, camera_m, score, time_ns, plane=FittedPlane.of(inliers))

    @property
    def distance_m(self) -> float:
        """Distance from the camera to the centroid; infinite without a camera."""
        return np.inf if self.camera_m is None else float(np.linalg.norm(self.centroid_m - self.camera_m))

    def is_flat(self, up: Float64[ndarray, "3"]) -> bool:
        """Return True if the cells cover a wide area at nearly one height, as those of a rug. up: in the world."""
        centres_m = _CELL_GRID.centres_m(self.cells).astype(np.float64)
        heights_m = centres_m @ up
        across_m = np.ptp(np.percentile(centres_m - heights_m[:, None] * up, INNER_PERCENTILES, axis=0), axis=0)
        width_m = float(np.linalg.norm(across_m))
        height_m = float(np.ptp(np.percentile(heights_m, INNER_PERCENTILES)))
        return width_m >= _MIN_FLAT_WIDTH_M and height_m <= _MAX_FLAT_SLOPE * width_m

    def is_panel(self, up: Float64[ndarray, "3"]) -> bool:
        """Return True if the points are thin and upright, as those of a screen. up: in the world."""
        return self.plane is not None and self.plane.is_panel(up)


@dataclass(slots=True, eq=False)
class Landmark:
    """One object over all its observations. Its centroid is the mean of its cells, not weighted by their counts.

    cells: keys of surface cells, with the number of observations of each in counts. missed_count: frames that should
    have shown the object but did not. farthest_m: the largest distance of an observation. first_seen_ns, last_seen_ns:
    capture times of its observations. number: assigned by the object map, in the order of first observations.
    score_sum: sum of its scores; rival_scores: sums of the scores of different things in its place. votes: of its
    masks, on its surface. missed_in_a_row: frames since the last detection that should have shown it.
    weak_count: frames with a weak detection only, whose score is in score_sum.
    colours: sums over its observations. supports_m: the latest levels of planes seen under it.
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
    first_seen_ns: int = 0
    last_seen_ns: int = 0
    number: int = 0
    score_sum: float = 0.0
    rival_scores: dict[str, float] = field(default_factory=dict)
    votes: SurfaceVotes = field(default_factory=SurfaceVotes.empty)
    missed_in_a_row: int = 0
    colours: Float64[ndarray, "balances ranges"] = field(default_factory=no_colours)
    supports_m: Float64[ndarray, " s"] = field(default_factory=lambda: np.zeros(0))
    weak_count: int = 0

    @classmethod
    def from_observation(cls, observation: Observation) -> Landmark:
        """Return a landmark of one observation."""
        counts = np.ones(len(observation.cells), np.int64)
        extent = (observation.phrase, observation.centroid_m, observation.radius_m, observation.cells, counts)
        return cls(
            *extent,
            seen_count=1,
            missed_count=0,
            best_score=observation.score,
            farthest_m=observation.distance_m,
            first_seen_ns=observation.time_ns,
            last_seen_ns=observation.time_ns,
            score_sum=observation.score,
            rival_scores={} if observation.rival is None else {observation.rival.name: observation.rival.score},
            votes=observation.votes,
            colours=observation.colours,
            supports_m=observation.supports_m,
        )

    def is_colocated_with(self, other: Observation) -> bool:
        """Return True if the centroids are close for the size of the smaller object."""
        max_distance_m = max(_MIN_MATCH_DISTANCE_M, 0.75 * min(self.radius_m, other.radius_m))
        return float(np.linalg.norm(self.centroid_m - other.centroid_m)) < max_distance_m

    def may_equal(self, other: Observation) -> bool:
        """Return True if an observation of another phrase may show this object: the same place, and a similar size.

        A bowl in the middle of a table has the table's centroid, but not its size.
        """
        is_similar = max(self.radius_m, other.radius_m) <= _MAX_SIZE_RATIO * min(self.radius_m, other.radius_m)
        return is_similar and self.is_colocated_with(other)

    def seen_from(self, camera_m: Float64[ndarray, "3"]) -> Observation:
        """Return the whole object as an observation by a camera, to evaluate relations."""
        place = self.phrase, self.centroid_m, self.radius_m, self.cells, camera_m
        return Observation(*place, votes=self.votes, colours=self.colours, supports_m=self.supports_m)

    def matches(self, other: Observation) -> bool:
        """Return True if an observation of the same phrase shows this object, in whole or in part."""
        shared = len(np.intersect1d(self.cells, other.cells, assume_unique=True))
        return self.is_colocated_with(other) or shared >= _MIN_SHARED * max(1, min(len(self.cells), len(other.cells)))

    def support(self, weak: Observation) -> None:
        """Count a weak detection of this object, without its inexact mask."""
        self.weak_count += 1
        self.missed_in_a_row = 0
        self.score_sum += weak.score
        self.last_seen_ns = max(self.last_seen_ns, weak.time_ns)
        if weak.rival is not None:
            self._add_rivals({weak.rival.name: weak.rival.score})

    def _add_rivals(self, scores: dict[str, float]) -> None:
        for name, score in scores.items():
            self.rival_scores[name] = self.rival_scores.get(name, 0.0) + score

    def add(self, other: Landmark) -> None:
        """Merge another landmark into this one, and recompute the centroid."""
        self.seen_count += other.seen_count
        self.weak_count += other.weak_count
        self.missed_count += other.missed_count
        self.best_score = max(self.best_score, other.best_score)
        self.farthest_m = max(self.farthest_m, other.farthest_m)
        self.first_seen_ns = min(self.first_seen_ns, other.first_seen_ns)
        self.last_seen_ns = max(self.last_seen_ns, other.last_seen_ns)
        self.score_sum += other.score_sum
        self.votes = self.votes.add(other.votes)
        self.colours = self.colours + other.colours
        self.supports_m = np.concatenate([self.supports_m, other.supports_m])[-MAX_SUPPORTS:]
        self.missed_in_a_row = min(self.missed_in_a_row, other.missed_in_a_row)
        self._add_rivals(other.rival_scores)
        merged, where = np.unique(np.concatenate([self.cells, other.cells]), return_inverse=True)
        total = np.bincount(where, weights=np.concatenate([self.counts, other.counts])).astype(np.int64)
        if len(merged) > _MAX_CELLS:
            most_observed = np.sort(np.argsort(-total, kind="stable")[:_MAX_CELLS])
            merged, total = merged[most_observed], total[most_observed]
        self.cells, self.counts = merged, total
        centres = self.footprint_m().astype(np.float64)
        self.centroid_m = centres.mean(axis=0)
        self.radius_m = 2.0 * float(np.median(np.linalg.norm(centres - self.centroid_m, axis=1)))

    def box_m(self) -> AxisAlignedBox:
        """Return the axis-aligned box of the footprint's cells."""
        centres, half_m = self.footprint_m().astype(np.float64), 0.5 * _CELL_GRID.size_m
        low, high = centres.min(axis=0) - half_m, centres.max(axis=0) + half_m
        return AxisAlignedBox((low[0], low[1], low[2]), (high[0], high[1], high[2]))

    def footprint_m(self) -> Float32[ndarray, "k 3"]:
        """Return the centres of the cells that are observed often, or of all cells if those are few."""
        reliable = self.cells[self.counts > max(1.0, _MIN_COUNT_SHARE * float(np.percentile(self.counts, 90)))]
        has_enough = len(reliable) >= _MIN_RELIABLE_SHARE * len(self.cells)
        return _CELL_GRID.centres_m(reliable if has_enough else self.cells)


class ObjectMap:
    """The landmarks of a task; at most _MAX_OBJECTS, the least observed is dropped first."""

    def __init__(self, objects: Sequence[Landmark] = ()) -> None:
        """Start with these landmarks, oldest first."""
        self._objects = list(objects)
        self._next_number = 1 + max((each.number for each in objects), default=0)

    @property
    def objects(self) -> tuple[Landmark, ...]:
        """All landmarks, oldest first."""
        return tuple(self._objects)

    def with_phrase(self, phrase: str) -> list[Landmark]:
        """Return the landmarks of a phrase."""
        return [each for each in self._objects if each.phrase == phrase]

    def match(self, observation: Observation) -> Landmark | None:
        """Return the landmark that an observation shows; None if there is none."""
        return next((each for each in self.with_phrase(observation.phrase) if each.matches(observation)), None)

    def observe(
        self, observations: Sequence[Observation], is_visible: Callable[[Landmark], bool] | None = None
    ) -> None:
        """Merge one frame's observations into their landmarks; an observation of several landmarks merges these.

        With is_visible, the other landmarks that the frame should have shown are counted as missed.
        """
        observed = [self._add(observation) for observation in observations if not observation.is_weak]
        for observation in observations:
            if observation.is_weak:
                self._support(observation, observed)
        if is_visible is not None:
            for each in self._objects:
                if not any(each is other for other in observed) and is_visible(each):
                    each.missed_count += 1
                    each.missed_in_a_row += 1
        while len(self._objects) > _MAX_OBJECTS:
            self._objects.remove(min(self._objects, key=lambda each: each.seen_count))

    def _add(self, observation: Observation) -> Landmark:
        new = Landmark.from_observation(observation)
        matches = [each for each in self.with_phrase(observation.phrase) if each.matches(observation)]
        if not matches:
            new.number, self._next_number = self._next_number, self._next_number + 1
            self._objects.append(new)
            return new
        matches[0].add(new)
        for other in matches[1:]:
            matches[0].add(other)
            self._objects.remove(other)
        return matches[0]

    def _support(self, weak: Observation, observed: list[Landmark]) -> None:
        """Count a weak observation for the nearest landmark that it shows, unless this frame already shows one.

        Its mask may cover several objects, so it merges none.
        """
        matches = [each for each in self.with_phrase(weak.phrase) if each.matches(weak)]
        if not matches or any(each is other for each in matches for other in observed):
            return
        nearest = min(matches, key=lambda each: float(np.linalg.norm(each.centroid_m - weak.centroid_m)))
        nearest.support(weak)
        observed.append(nearest)
