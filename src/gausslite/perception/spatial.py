"""Keep the detections whose place in space fits the task's relations (Sec. III-B.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.camera import lift
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis, transform_points, unit_up_axis
from gausslite.domain.relevance import Detection
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.evidence import EvidenceSettings, VisibilityCheck
from gausslite.perception.object_map import Landmark, ObjectMap, Observation
from gausslite.perception.relations import RelationGeometry, SpatialSettings, surface_distance_m

_MIN_PIXELS = 8
_MAX_PIXELS = 4000


def best_depth_m(
    sensor_m: Float32[ndarray, "h w"], rendered_m: Float32[ndarray, "h w"] | None
) -> Float32[ndarray, "h w"]:
    """The map's depth where it has drawn something, the sensor's elsewhere."""
    if rendered_m is None or rendered_m.shape != sensor_m.shape:
        return sensor_m
    return np.where(rendered_m > 0, rendered_m, sensor_m)


def lift_observation(detection: Detection, depth_m: Float32[ndarray, "h w"], frame: Frame) -> Observation | None:
    """Lift a detection's mask to its centroid in the world; None where too few of its pixels have depth.

    Instead of the one pixel at the 2D centroid, which may lie beside the object, all its pixels are lifted.
    """
    rows, columns = np.nonzero(detection.mask & (depth_m > 0))
    if len(rows) < _MIN_PIXELS:
        return None
    step = max(1, len(rows) // _MAX_PIXELS)
    rows, columns = rows[::step], columns[::step]
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m[rows, columns].astype(np.float64), frame.camera)
    T_world_camera = frame.T_world_camera
    points_m = transform_points(T_world_camera, points)
    return Observation.from_points(detection.phrase, points_m, T_world_camera[:3, 3], detection.score)


class SpatialFilter:
    """Evaluates the graph's relations against everything seen so far; anchors stay where they were last seen."""

    def __init__(
        self, graph: TaskGraph, up_axis: UpAxis, settings: SpatialSettings, evidence: EvidenceSettings | None = None
    ) -> None:
        self._relations = {
            target: tuple(relation for relation in graph.relations if relation.target == target)
            for target in graph.targets
        }
        self._geometry = RelationGeometry(np.array(unit_up_axis(up_axis)), settings)
        self._evidence = evidence or EvidenceSettings()
        self._object_map = ObjectMap()

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """Every object seen so far, where it was seen on average."""
        return self._object_map.objects

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Anchors that some relation needs and no frame has shown yet."""
        needed = dict.fromkeys(each.anchor for relations in self._relations.values() for each in relations)
        return tuple(anchor for anchor in needed if not self._object_map.with_phrase(anchor))

    def observe(self, observations: Sequence[Observation], outlook: VisibilityCheck | None = None) -> None:
        """Take one frame's observations into the memory; with an outlook, also what it should have shown and did not."""
        self._object_map.observe(observations, None if outlook is None else outlook.is_visible)

    def is_confirmed(self, observation: Observation) -> bool:
        """True when what was sighted is there for all that is known of it."""
        shown = self._object_map.match(observation)
        return shown is not None and self._evidence.is_confirmed(shown)

    def is_reliable(self, observation: Observation) -> bool:
        """True when what was sighted could not be two mistakes."""
        shown = self._object_map.match(observation)
        return shown is not None and self._evidence.is_reliable(shown)

    def is_same_object(self, observation: Observation, other: Observation) -> bool:
        """True when two observations show one and the same object."""
        shown = self._object_map.match(observation)
        return shown is not None and shown is self._object_map.match(other)

    def needs_observation(self, observation: Observation) -> bool:
        """True when another look could settle whether it is there."""
        shown = self._object_map.match(observation)
        return shown is not None and self._evidence.needs_observation(shown)

    def restore_landmarks(self, objects: Sequence[Landmark]) -> None:
        """Start from objects of an earlier life, oldest first."""
        self._object_map = ObjectMap(objects)

    def satisfies_relations(self, observation: Observation) -> bool:
        """Any relation of the target holds (Sec. III-B.3); True without relations or without their anchors.

        A target is judged by the anchors that were seen; while none of them was, it is kept, for want of evidence.
        All the anchors of `between` make one relation.
        """
        relations = self._relations.get(observation.phrase, ())
        seen = [each for each in relations if self._object_map.with_phrase(each.anchor)]
        held = [self._holds(each, observation) for each in seen if each.predicate is not Predicate.BETWEEN]
        anchors = [self._anchors(each, observation) for each in relations if each.predicate is Predicate.BETWEEN]
        between = self._geometry.between(observation, anchors) if anchors else None
        judged = held if between is None else [*held, between]
        return not judged or any(judged)

    def _anchors(self, relation: Relation, observation: Observation) -> list[Landmark]:
        """The relation's anchors without the target itself."""
        return [each for each in self._confirmed_landmarks(relation.anchor) if not each.is_colocated_with(observation)]

    def _holds(self, relation: Relation, observation: Observation) -> bool:
        if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
            return self._is_extreme(relation, observation)
        anchors = self._anchors(relation, observation)
        return any(self._geometry.holds(relation.predicate, observation, anchor) for anchor in anchors)

    def _is_extreme(self, relation: Relation, observation: Observation) -> bool:
        """Of all firm candidates, only the one whose surface is least (most) apart from that of its nearest anchor."""
        sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
        anchors = self._confirmed_landmarks(relation.anchor)
        best, least_m = None, np.inf
        for candidate in self._reliable_landmarks(relation.target):
            to_anchors_m = [surface_distance_m(candidate, each) for each in anchors if each is not candidate]
            if to_anchors_m and sign * min(to_anchors_m) < least_m:
                best, least_m = candidate, sign * min(to_anchors_m)
        return best is not None and best.matches(observation)

    def _reliable_landmarks(self, phrase: str) -> list[Landmark]:
        """The objects that may decide between all that answer a phrase; the believed ones while there is none."""
        credible = self._confirmed_landmarks(phrase)
        return [each for each in credible if self._evidence.is_reliable(each)] or credible

    def _confirmed_landmarks(self, phrase: str) -> list[Landmark]:
        """The believed objects that answer a phrase, or all while none is."""
        named = self._object_map.with_phrase(phrase)
        return [each for each in named if self._evidence.is_confirmed(each)] or named
