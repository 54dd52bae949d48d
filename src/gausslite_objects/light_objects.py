"""Remember everything that a detector sees: box, class and times of what the task does not name, without detail.

`LightObjects` is the default plug-in of the group `gausslite.object_memories`. The detector finds these things anyway;
they get no share of the map's budget, and only their boxes leave the robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from threading import Lock

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.errors import CodecError, MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import (
    MAX_OBJECTS_PER_AGENT,
    MatchBasis,
    NounMatch,
    NounReport,
    ObjectLandmark,
    ObjectRole,
)
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.relevance import UNNAMED, Detection, PointM, RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, int_array, select_prefix
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.nouns import normalised_noun, same_kind
from gausslite.perception.detector import Detector
from gausslite.perception.evidence import Evidence, VisibilityCheck
from gausslite.perception.lifting import lift_detections
from gausslite.perception.object_map import ObjectMap, describe_landmarks
from gausslite.perception.relevance import RelevanceEstimate, RelevanceEstimator
from gausslite.perception.relevance_tracker import decode_landmark, encode_landmark
from gausslite.perception.settings import EvidenceSettings
from gausslite.perception.surface import SurfaceVotes
from gausslite_objects.areas import Area, TaskPlaces, decode_areas, encode_areas, joined
from gausslite_objects.edits import Edit, decode_edits, effective, encode_edits, is_denied

_MAX_REPORTED = 100
"""Of one robot: 14 kB in a report."""
_FINE_RADIUS_M = 0.25
"""Larger things keep no votes on their surface, and their boxes are those of cells of 5 cm: votes on all take 13 MB in
a kitchen, and boxes in cells hide that a book on a table is gone."""
_SAME_IOU = 0.4
"""Of the boxes of one thing under two names; a thing on or in another one has less."""
_MAX_RATIO = 2.5
"""Of the longest sides of one thing under two names."""
_CLASSES = (MatchBasis.GENERIC, MatchBasis.REGION)
_SAID = ("edits", "areas", "team_areas")


class LightObjects:
    """A Detector that also detects all classes of another one, and remembers them and what people say. Thread-safe.

    A detector that is prompted by text has no classes: then nothing is remembered. What people say is changed between
    frames: a noun of the task means nothing that an edit denies, and nothing outside of the area that the task names.
    """

    def __init__(self, detector: Detector, up_axis: UpAxis) -> None:
        self._detector, self._up_axis, self._up = detector, up_axis, np.array(unit_up_axis(up_axis))
        self._has_classes = detector.matches((UNNAMED,))[0].basis in _CLASSES
        self._evidence, self._seen = Evidence(EvidenceSettings()), ObjectMap()
        self._lock = Lock()
        self.edits: tuple[Edit, ...] = ()
        self.areas: tuple[Area, ...] = ()
        self.team_areas: tuple[Area, ...] = ()
        """Those named on the team's server, in this robot's frame; an own one of the same name wins."""
        self._graph = TaskGraph("", "", (), (), ())
        self.places = TaskPlaces.of(self._graph, ())
        """Where the objects of the task's nouns are."""
        self.changes = 0
        """How often people have changed what the task's nouns mean."""

    @property
    def known_areas(self) -> tuple[Area, ...]:
        """All areas that a task may name."""
        return joined(self.areas, self.team_areas)

    def change(self, edits: tuple[Edit, ...], areas: tuple[Area, ...], team_areas: tuple[Area, ...]) -> bool:
        """Replace what people said; return True if the task's nouns mean other objects now."""
        before, self.edits, self.areas, self.team_areas = self._meaning(), edits, areas, team_areas
        self.places = TaskPlaces.of(self._graph, self.known_areas)
        is_other = self._meaning() != before
        self.changes += is_other
        return is_other

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what the detector searches for each query, and where its objects can be."""
        found = self._detector.matches(queries)
        return tuple(replace(match, is_there=partial(self._is_there, match.noun)) for match in found)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the detections of the queries that are no areas; those of all classes enter the memory."""
        queries = tuple(query for query in queries if query.casefold() not in self.places.anchors)
        if not self._has_classes:
            return self._detector.detect(frame, queries)
        is_asked = UNNAMED in queries
        found = self._detector.detect(frame, queries if is_asked else (*queries, UNNAMED))
        self._observe(frame, [seen for seen in found if seen.phrase == UNNAMED and seen.class_name])
        return found if is_asked else [seen for seen in found if seen.phrase != UNNAMED]

    def remember(self, estimator: RelevanceEstimator, graph: TaskGraph) -> RelevanceEstimator:
        """Return the task's estimator with these objects after its own."""
        self._graph, self.places = graph, TaskPlaces.of(graph, self.known_areas)
        return RememberingEstimator(estimator, self)

    def _meaning(self) -> object:
        nouns = set(map(noun_of, self._graph.targets))
        return self.places, [edit for edit in effective(self.edits) if edit.denied_noun in nouns]

    def _is_there(self, noun: str, point_m: Float64[ndarray, "3"]) -> bool:
        x, y, z = point_m.tolist()
        is_meant = self.places.contain(noun, (x, y, z), self._up_axis)
        return is_meant and not (self.edits and is_denied(self.edits, noun, (x, y, z)))

    def _observe(self, frame: Frame, detections: Sequence[Detection]) -> None:
        named = [replace(found, phrase=normalised_noun(found.class_name)) for found in detections if not found.is_weak]
        lifted = lift_detections(named, frame.depth_m, frame, self._up)
        with self._lock:
            self._seen.observe(
                [observation for _, observation in lifted], VisibilityCheck(frame, frame.depth_m).is_visible
            )
            for landmark in self._seen.objects:
                if landmark.radius_m > _FINE_RADIUS_M:
                    landmark.votes = SurfaceVotes.empty()

    def beside(self, objects: Sequence[ObjectLandmark]) -> list[ObjectLandmark]:
        """Return the objects of two independent views that are none of these, each under its most confident name."""
        with self._lock:
            confirmed = [
                (landmark, ObjectRole.OTHER)
                for landmark in self._evidence.confirmed(self._seen.objects)
                if landmark.view_count >= self._evidence.settings.min_seen
            ]
            found = describe_landmarks(confirmed)
        kept: list[ObjectLandmark] = []
        for landmark in found:
            is_part = any(_is_part(landmark, other) for other in (*objects, *found))
            if not is_part and not any(_is_double(landmark, other) for other in (*objects, *kept)):
                kept.append(replace(landmark, object_id=f"seen/{landmark.object_id}"))
        return kept[:_MAX_REPORTED]

    def state(self) -> State:
        """Return what is remembered and said as named arrays."""
        with self._lock:
            landmarks = self._seen.objects
            encoded = [add_prefix(f"landmark-{i}", encode_landmark(landmark)) for i, landmark in enumerate(landmarks)]
        said = encode_edits(self.edits), encode_areas(self.areas), encode_areas(self.team_areas)
        arrays = {name: np.frombuffer(data, np.uint8) for name, data in zip(_SAID, said, strict=True)}
        return {"count": int_array(len(landmarks)), **arrays, **{name: own[name] for own in encoded for name in own}}

    def restore(self, state: State) -> None:
        """Replace what is remembered and said. Raises MapFileError, InvalidInputError."""
        # runs that were saved before an agent had them have none
        edits, *areas = (
            get_array(state, name, (None,), np.uint8).tobytes() if name in state else b"" for name in _SAID
        )
        try:
            self.edits, (self.areas, self.team_areas) = decode_edits(edits), map(decode_areas, areas)
        except CodecError as error:
            raise MapFileError(f"state light objects: {error}") from error
        self.places = TaskPlaces.of(self._graph, self.known_areas)
        (count,) = get_counts(state, "count", 1)
        if count > len(state):
            raise MapFileError(f"state light objects: expected {count} landmarks, got fewer")
        with self._lock:
            self._seen.restore([decode_landmark(select_prefix(state, f"landmark-{i}"), None) for i in range(count)])


class RememberingEstimator(RelevanceEstimator):
    """A RelevanceEstimator with the light objects of its detector among its objects and in its state."""

    def __init__(self, estimator: RelevanceEstimator, memory: LightObjects) -> None:
        self._estimator, self._memory, self._changes = estimator, memory, memory.changes

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """Return the task's relevance of one frame."""
        return self._estimator.estimate(frame, rendered_depth_m)

    def evaluate_past(self, frame: Frame) -> RelevanceMap | None:
        """Return the relevance of an earlier frame; after people changed what the task means, of what is known."""
        if self._memory.changes > self._changes:
            # the detections of this frame are in it
            return self._estimator.complete(frame, RelevanceMap.empty(*frame.depth_m.shape))
        return self._estimator.evaluate_past(frame)

    @property
    def known_objects(self) -> int:
        """The number of the task's objects that relevance maps include from now on."""
        return self._estimator.known_objects

    def complete(self, frame: Frame, relevance: RelevanceMap) -> RelevanceMap:
        """Return an earlier frame's relevance with the task's objects that became known since."""
        return self._estimator.complete(frame, relevance)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator; none on anchors that are areas."""
        places = self._memory.places
        own = (note for note in self._estimator.notes if not any(repr(name) in note for name in places.anchors))
        return (*own, *places.notes)

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the task, then the light ones."""
        own = self._estimator.objects
        return (*own, *self._memory.beside(own))[:MAX_OBJECTS_PER_AGENT]

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """What is searched for each noun of the task, and what was detected."""
        anchors = self._memory.places.anchors
        return tuple(noun for noun in self._estimator.nouns if noun.match.noun.casefold() not in anchors)

    def point_at(self, noun: str, mask: Bool[ndarray, "h w"], frame: Frame) -> None:
        """Add the object that a person points at. Raises InvalidInputError."""
        self._estimator.point_at(noun, mask, frame)

    def exclude(self, point_m: PointM) -> None:
        """Leave out the task's object at a point in the world. Raises InvalidInputError."""
        self._estimator.exclude(point_m)

    def state(self) -> State:
        """Return the task's state, and what is remembered."""
        return {**self._estimator.state(), **add_prefix("light", self._memory.state())}

    def restore(self, state: State) -> None:
        """Replace both. Raises MapFileError, InvalidInputError."""
        self._estimator.restore(state)
        # without one, the state was saved where nothing was remembered
        if light := select_prefix(state, "light"):
            self._memory.restore(light)


def _is_part(one: ObjectLandmark, other: ObjectLandmark) -> bool:
    """Return True if one is of the other's noun, smaller, and has its centre in the other's box."""
    is_smaller = np.prod(one.size_m) < np.prod(other.size_m)
    return bool(one.noun == other.noun and is_smaller and other.distance_m(one.centroid_m) == 0.0)


def _is_double(one: ObjectLandmark, other: ObjectLandmark) -> bool:
    """Return True if two entries are one thing: their boxes agree, or one of a kind has its centre in the other."""
    low, high = (
        np.maximum(one.extent_m.min_m, other.extent_m.min_m),
        np.minimum(one.extent_m.max_m, other.extent_m.max_m),
    )
    shared = float(np.prod(np.maximum(high - low, 0.0)))
    union = float(np.prod(one.size_m) + np.prod(other.size_m)) - shared
    if shared > _SAME_IOU * union:
        return True
    short_m, long_m = sorted((max(one.size_m), max(other.size_m)))
    is_inside = min(one.distance_m(other.centroid_m), other.distance_m(one.centroid_m)) == 0.0
    is_kind = same_kind(one.noun, other.noun) or same_kind(other.noun, one.noun)
    return is_kind and is_inside and long_m <= _MAX_RATIO * short_m
