"""Landmarks: the detected objects in world coordinates, each merged from partial observations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.objects import MAX_OBJECTS_PER_AGENT, ObjectLandmark, ObjectRole
from gausslite.domain.relevance import CompetingClass
from gausslite.domain.state import State
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.perception.surface import SurfaceVotes

CELL_M = 0.05
"""Edge of the cells that an object occupies."""
_MIN_MATCH_DISTANCE_M = 0.15
"""Distance of centroids below which even small objects are the same."""
_MATCH_RADIUS_SHARE = 0.75
"""Distance of centroids, relative to the smaller radius, below which objects are the same."""
_MAX_SIZE_RATIO = 2.0
"""Ratio of radii above which objects of two nouns differ: a bowl in the middle of a table is not the table."""
_MIN_SHARED_SHARE = 0.3
"""Share of the smaller object's cells that the same object has."""
_MIN_COUNT_SHARE = 0.15
"""Observations of a cell, relative to the often observed ones, above which it belongs to the footprint."""
_MIN_FOOTPRINT_SHARE = 0.25
"""Share of the cells that a footprint has; below, all cells count."""
INDEPENDENT_NS, _INDEPENDENT_M = 1_000_000_000, 0.1
"""Time or motion of the camera from which a further observation is independent."""
_MAX_CELLS = 4000
MAX_OBJECTS = 500
"""Objects of a task; the least observed one is dropped first."""


@runtime_checkable
class Measured(Protocol):
    """What a plug-in has measured of an object's attributes, in one or several observations (`Selector.measured`)."""

    def add(self, other: Self) -> Self:
        """Return the attributes over the observations of both."""

    def state(self) -> State:
        """Return the attributes as named arrays."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One object in one frame: centroid in the world, keys of its surface cells, radius, camera centre, score.

    The radius is twice the median distance of the points to the centroid: masks of chairs include background, which
    would dominate the outermost points. camera_m is the camera's centre, None without a camera. time_ns is the frame's
    capture time. votes: which voxels the mask shows inside and outside the object.
    """

    phrase: str  # the noun of the task
    centroid_m: Float64[ndarray, "3"]
    radius_m: float
    cells: Int64[ndarray, " k"]
    camera_m: Float64[ndarray, "3"] | None = None
    score: float = 1.0
    time_ns: int = 0
    rival: CompetingClass | None = None  # a different thing detected in the same place
    votes: SurfaceVotes = field(default_factory=SurfaceVotes.empty)
    is_weak: bool = False  # of a weak detection
    measured: Measured | None = None  # attributes that the mask shows

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
        centroid_m = np.median(points_m, axis=0)  # not the mean: masks include background
        radius_m = 2.0 * float(np.median(np.linalg.norm(points_m - centroid_m, axis=1)))
        inliers_m = points_m[_is_inlier(points_m, centroid_m, radius_m)]
        cells = np.unique(VoxelGrid(CELL_M).keys(inliers_m.astype(np.float32)))
        return cls(phrase, centroid_m, radius_m, cells, camera_m, score=score, time_ns=time_ns)

    def without_outliers(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "m 3"]:
        """Return those of the mask's points that are near the centroid for the object's size."""
        near: Float64[ndarray, "m 3"] = points_m[_is_inlier(points_m, self.centroid_m, self.radius_m)]
        return near

    @property
    def distance_m(self) -> float:
        """Distance from the camera to the centroid; infinite without a camera."""
        return np.inf if self.camera_m is None else float(np.linalg.norm(self.centroid_m - self.camera_m))


def _is_inlier(
    points_m: Float64[ndarray, "n 3"], centroid_m: Float64[ndarray, "3"], radius_m: float
) -> Bool[ndarray, " n"]:
    distances_m = np.linalg.norm(points_m - centroid_m, axis=1)
    is_inlier: Bool[ndarray, " n"] = distances_m <= 2.0 * max(radius_m, _MIN_MATCH_DISTANCE_M)
    return is_inlier


@dataclass(slots=True, eq=False)
class Landmark:
    """One object over all its observations. Its centroid is the mean of its cells, not weighted by their counts.

    first_seen_ns, last_seen_ns: capture times of its observations.
    """

    phrase: str  # the noun of the task
    centroid_m: Float64[ndarray, "3"]
    radius_m: float
    cells: Int64[ndarray, " k"]  # keys of surface cells, with the number of observations of each in counts
    counts: Int64[ndarray, " k"]
    seen_count: int  # frames that detected it
    missed_count: int  # frames that should have shown the object but did not
    best_score: float  # of all detections
    farthest_m: float  # the largest distance of an observation
    first_seen_ns: int = 0
    last_seen_ns: int = 0
    number: int = 0  # assigned by the object map, in the order of first observations
    view_count: int = 1  # independent observations, the last one at view_ns from view_camera_m
    view_camera_m: Float64[ndarray, "3"] | None = None
    view_ns: int = 0
    score_sum: float = 0.0  # sum of its scores
    rival_scores: dict[str, float] = field(default_factory=dict)  # sums of the scores of different things in its place
    votes: SurfaceVotes = field(default_factory=SurfaceVotes.empty)  # of its masks, on its surface
    missed_in_a_row: int = 0  # frames since the last detection that should have shown it
    weak_count: int = 0  # frames with a weak detection only, whose score is in score_sum
    is_given: bool = False  # a person has pointed at it, so it exists whatever detections say
    measured: Measured | None = None  # its attributes so far

    @classmethod
    def from_observation(cls, observation: Observation) -> Self:
        """Return a landmark of one observation."""
        return cls(
            phrase=observation.phrase,
            centroid_m=observation.centroid_m,
            radius_m=observation.radius_m,
            cells=observation.cells,
            counts=np.ones(len(observation.cells), np.int64),
            seen_count=1,
            missed_count=0,
            best_score=observation.score,
            farthest_m=observation.distance_m,
            first_seen_ns=observation.time_ns,
            last_seen_ns=observation.time_ns,
            view_camera_m=observation.camera_m,
            view_ns=observation.time_ns,
            score_sum=observation.score,
            rival_scores={} if observation.rival is None else {observation.rival.name: observation.rival.score},
            votes=observation.votes,
            measured=observation.measured,
        )

    def is_colocated_with(self, other: Observation | Landmark) -> bool:
        """Return True if the centroids are close for the size of the smaller object."""
        smaller_m = min(self.radius_m, other.radius_m)
        max_distance_m = max(_MIN_MATCH_DISTANCE_M, _MATCH_RADIUS_SHARE * smaller_m)
        return float(np.linalg.norm(self.centroid_m - other.centroid_m)) < max_distance_m

    def may_equal(self, other: Observation | Landmark) -> bool:
        """Return True if an object of another phrase may be this one: the same place, and a similar size."""
        smaller_m, larger_m = sorted((self.radius_m, other.radius_m))
        return larger_m <= _MAX_SIZE_RATIO * smaller_m and self.is_colocated_with(other)

    def matches(self, other: Observation | Landmark) -> bool:
        """Return True if an observation or a double of the same phrase shows this object, in whole or in part."""
        shared = len(np.intersect1d(self.cells, other.cells, assume_unique=True))
        smaller = max(1, min(len(self.cells), len(other.cells)))
        return self.is_colocated_with(other) or shared >= _MIN_SHARED_SHARE * smaller

    @property
    def confidence(self) -> float:
        """The best score times the share of frames that detected the object, of those that should have."""
        if self.is_given:
            return 1.0
        return min(max(self.best_score, 0.0), 1.0) * self.seen_count / (self.seen_count + self.missed_count)

    def seen_from(self, camera_m: Float64[ndarray, "3"]) -> Observation:
        """Return the whole object as an observation by a camera, to evaluate relations."""
        return Observation(
            phrase=self.phrase,
            centroid_m=self.centroid_m,
            radius_m=self.radius_m,
            cells=self.cells,
            camera_m=camera_m,
            votes=self.votes,
            measured=self.measured,
        )

    def add_weak(self, weak: Observation) -> None:
        """Count a weak detection of this object, without its inexact mask."""
        self.weak_count += 1
        self.missed_in_a_row = 0  # weak, but seen
        self.score_sum += weak.score
        self.last_seen_ns = max(self.last_seen_ns, weak.time_ns)
        if weak.rival is not None:
            self._add_rivals({weak.rival.name: weak.rival.score})

    def add(self, other: Landmark) -> None:
        """Merge another landmark into this one, and recompute the centroid."""
        self.is_given |= other.is_given
        self.seen_count += other.seen_count
        if self._is_independent_of(other):  # two images of one moment err alike
            self.view_count += other.view_count
            self.view_camera_m, self.view_ns = other.view_camera_m, other.view_ns
        self.weak_count += other.weak_count
        self.missed_count += other.missed_count
        self.best_score = max(self.best_score, other.best_score)
        self.farthest_m = max(self.farthest_m, other.farthest_m)
        self.first_seen_ns = min(self.first_seen_ns, other.first_seen_ns)
        self.last_seen_ns = max(self.last_seen_ns, other.last_seen_ns)
        self.score_sum += other.score_sum
        self.votes = self.votes.add(other.votes)
        if self.measured is not None and other.measured is not None:
            self.measured = self.measured.add(other.measured)
        self.missed_in_a_row = min(self.missed_in_a_row, other.missed_in_a_row)
        self._add_rivals(other.rival_scores)
        self._add_cells(other)

    def _is_independent_of(self, other: Landmark) -> bool:
        """Return True if another time or viewpoint shows it: two images of one moment err alike."""
        if abs(other.view_ns - self.view_ns) >= INDEPENDENT_NS or other.view_camera_m is None:
            return True
        baseline_m = 0.0 if self.view_camera_m is None else np.linalg.norm(other.view_camera_m - self.view_camera_m)
        return bool(baseline_m >= _INDEPENDENT_M)

    def _add_rivals(self, scores: dict[str, float]) -> None:
        for name, score in scores.items():
            self.rival_scores[name] = self.rival_scores.get(name, 0.0) + score

    def _add_cells(self, other: Landmark) -> None:
        # a cell counts the frames that showed it: background inside a mask is not seen from other sides
        merged, where = np.unique(np.concatenate([self.cells, other.cells]), return_inverse=True)
        total = np.bincount(where, weights=np.concatenate([self.counts, other.counts])).astype(np.int64)
        if len(merged) > _MAX_CELLS:
            # bounded: a room-sized mask would fill memory
            most_observed = np.sort(np.argsort(-total, kind="stable")[:_MAX_CELLS])
            merged, total = merged[most_observed], total[most_observed]
        self.cells, self.counts = merged, total
        centres_m = self.footprint_m().astype(np.float64)
        self.centroid_m = centres_m.mean(axis=0)
        self.radius_m = 2.0 * float(np.median(np.linalg.norm(centres_m - self.centroid_m, axis=1)))

    def contains(self, point_m: Float64[ndarray, "3"]) -> bool:
        """Return True if a point is in the box of the footprint, or within half a cell of it."""
        box, slack_m = self.box_m(), 0.5 * CELL_M
        inside = (point_m >= np.array(box.min_m) - slack_m) & (point_m <= np.array(box.max_m) + slack_m)
        return bool(inside.all())

    def box_m(self) -> AxisAlignedBox:
        """Return the axis-aligned box of the surface on which the masks agree, or of the footprint's cells.

        It contains no place that another noun's masks claim too: such places have votes, but no cells.
        """
        surface, half_m = self.votes.box, 0.5 * CELL_M
        cells_m = self.footprint_m() if surface is None else VoxelGrid(CELL_M).centres_m(self.cells)
        corners_m = np.stack([cells_m.min(axis=0) - half_m, cells_m.max(axis=0) + half_m]).astype(np.float64)
        if surface is not None:
            corners_m = np.clip(np.array([surface.min_m, surface.max_m]), *corners_m)
        return AxisAlignedBox.around(corners_m)

    def footprint_m(self) -> Float32[ndarray, "k 3"]:
        """Return the centres of the cells that are observed often, or of all cells if those are few."""
        often = _MIN_COUNT_SHARE * float(np.percentile(self.counts, 90))
        reliable = self.cells[self.counts > max(1.0, often)]
        has_enough = len(reliable) >= _MIN_FOOTPRINT_SHARE * len(self.cells)
        return VoxelGrid(CELL_M).centres_m(reliable if has_enough else self.cells)


class ObjectMap:
    """The landmarks of a task; of too many, the least observed is dropped first."""

    def __init__(self) -> None:
        self._objects: list[Landmark] = []
        self._next_number = 1

    @property
    def objects(self) -> tuple[Landmark, ...]:
        """All landmarks, oldest first."""
        return tuple(self._objects)

    def restore(self, objects: Sequence[Landmark]) -> None:
        """Replace the landmarks by these, oldest first."""
        self._objects = list(objects)
        self._next_number = 1 + max((landmark.number for landmark in objects), default=0)

    def with_phrase(self, phrase: str) -> list[Landmark]:
        """Return the landmarks of a phrase."""
        return [landmark for landmark in self._objects if landmark.phrase == phrase]

    def match(self, observation: Observation) -> Landmark | None:
        """Return the landmark that an observation shows; None if there is none."""
        return next(iter(self._matches(observation)), None)

    def observe(
        self, observations: Sequence[Observation], is_visible: Callable[[Landmark], bool] | None = None
    ) -> None:
        """Merge one frame's observations into their landmarks, and landmarks that are doubles of the observed ones.

        With is_visible, the other landmarks that the frame should have shown are counted as missed.
        """
        # exact masks first: a weak detection only counts for what none of them shows
        observed = [self._add(observation) for observation in observations if not observation.is_weak]
        for observation in observations:
            if observation.is_weak:
                self._add_weak(observation, observed)
        if is_visible is not None:
            for landmark in self._objects:
                if not any(landmark is other for other in observed) and is_visible(landmark):
                    landmark.missed_count += 1
                    landmark.missed_in_a_row += 1
        while len(self._objects) > MAX_OBJECTS:
            self._objects.remove(min(self._objects, key=lambda landmark: (landmark.is_given, landmark.seen_count)))

    def _matches(self, observation: Observation) -> list[Landmark]:
        return [landmark for landmark in self.with_phrase(observation.phrase) if landmark.matches(observation)]

    def _add(self, observation: Observation) -> Landmark:
        new, matches = Landmark.from_observation(observation), self._matches(observation)
        if not matches:
            new.number, self._next_number = self._next_number, self._next_number + 1
            self._objects.append(new)
            return new
        first = matches[0]
        first.add(new)
        doubles = matches[1:]
        while doubles:
            for other in doubles:
                first.add(other)
                self._objects.remove(other)
            # the merged object may reach further ones
            doubles = [other for other in self.with_phrase(first.phrase) if other is not first and first.matches(other)]
        return first

    def _add_weak(self, weak: Observation, observed: list[Landmark]) -> None:
        """Count a weak observation for the nearest landmark without one in this frame; it merges none."""
        matches = self._matches(weak)
        if not matches or any(landmark is other for landmark in matches for other in observed):
            return
        nearest = min(matches, key=lambda landmark: float(np.linalg.norm(landmark.centroid_m - weak.centroid_m)))
        nearest.add_weak(weak)
        observed.append(nearest)


def describe_landmarks(landmarks: Sequence[tuple[Landmark, ObjectRole]]) -> tuple[ObjectLandmark, ...]:
    """Return the landmarks as values for a report: targets, anchors, others; the most confident ones first."""
    roles = list(ObjectRole)
    described = [_describe(landmark, role) for landmark, role in landmarks]
    described.sort(key=lambda landmark: (roles.index(landmark.role), -landmark.confidence))
    return tuple(described[:MAX_OBJECTS_PER_AGENT])


def _describe(landmark: Landmark, role: ObjectRole) -> ObjectLandmark:
    box = landmark.box_m()
    low_m, high_m = np.array(box.min_m), np.array(box.max_m)
    # the mean of the cells can lie behind the object, where masks also show what is there
    is_inside = (landmark.centroid_m >= low_m) & (landmark.centroid_m <= high_m)
    x, y, z = np.where(is_inside, landmark.centroid_m, 0.5 * (low_m + high_m)).tolist()
    return ObjectLandmark(
        object_id=f"{landmark.phrase}-{landmark.number}",
        noun=landmark.phrase,
        role=role,
        centroid_m=(x, y, z),
        extent_m=box,
        confidence=landmark.confidence,
        first_seen_ns=landmark.first_seen_ns,
        last_seen_ns=landmark.last_seen_ns,
    )
