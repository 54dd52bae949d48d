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
from gausslite.perception.evidence import EvidenceSettings, Outlook
from gausslite.perception.object_map import Landmark, ObjectMap, Observation
from gausslite.perception.relations import Geometry, SpatialSettings, apart_m

_MIN_PIXELS = 8
_MAX_PIXELS = 4000


def best_depth_m(
    sensor_m: Float32[ndarray, "h w"], rendered_m: Float32[ndarray, "h w"] | None
) -> Float32[ndarray, "h w"]:
    """The map's depth where it has drawn something, the sensor's elsewhere."""
    if rendered_m is None or rendered_m.shape != sensor_m.shape:
        return sensor_m
    return np.where(rendered_m > 0, rendered_m, sensor_m)


def sight(detection: Detection, depth_m: Float32[ndarray, "h w"], frame: Frame) -> Observation | None:
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
        self._geometry = Geometry(np.array(unit_up_axis(up_axis)), settings)
        self._evidence = evidence or EvidenceSettings()
        self._memory = ObjectMap()

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """Every object seen so far, where it was seen on average."""
        return self._memory.objects

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Anchors that some relation needs and no frame has shown yet."""
        needed = dict.fromkeys(each.anchor for relations in self._relations.values() for each in relations)
        return tuple(anchor for anchor in needed if not self._memory.named(anchor))

    def observe(self, sightings: Sequence[Observation], outlook: Outlook | None = None) -> None:
        """Take one frame's sightings into the memory; with an outlook, also what it should have shown and did not."""
        self._memory.observe(sightings, None if outlook is None else outlook.shows_place_of)

    def is_confirmed(self, sighting: Observation) -> bool:
        """True when what was sighted is there for all that is known of it."""
        shown = self._memory.showing(sighting)
        return shown is not None and self._evidence.is_confirmed(shown)

    def is_reliable(self, sighting: Observation) -> bool:
        """True when what was sighted could not be two mistakes."""
        shown = self._memory.showing(sighting)
        return shown is not None and self._evidence.is_reliable(shown)

    def is_same_object(self, sighting: Observation, other: Observation) -> bool:
        """True when two sightings show one and the same object."""
        shown = self._memory.showing(sighting)
        return shown is not None and shown is self._memory.showing(other)

    def needs_observation(self, sighting: Observation) -> bool:
        """True when another look could settle whether it is there."""
        shown = self._memory.showing(sighting)
        return shown is not None and self._evidence.needs_observation(shown)

    def remember(self, objects: Sequence[Landmark]) -> None:
        """Start from objects of an earlier life, oldest first."""
        self._memory = ObjectMap(objects)

    def keep(self, sighting: Observation) -> bool:
        """Any relation of the target holds (Sec. III-B.3); True without relations or without their anchors.

        A target is judged by the anchors that were seen; while none of them was, it is kept, for want of evidence.
        All the anchors of `between` make one relation.
        """
        relations = self._relations.get(sighting.phrase, ())
        seen = [each for each in relations if self._memory.named(each.anchor)]
        held = [self._holds(each, sighting) for each in seen if each.predicate is not Predicate.BETWEEN]
        anchors = [self._others(each, sighting) for each in relations if each.predicate is Predicate.BETWEEN]
        between = self._geometry.between(sighting, anchors) if anchors else None
        judged = held if between is None else [*held, between]
        return not judged or any(judged)

    def _others(self, relation: Relation, sighting: Observation) -> list[Landmark]:
        """The relation's anchors without the target itself."""
        return [each for each in self._credible(relation.anchor) if not each.is_at(sighting)]

    def _holds(self, relation: Relation, sighting: Observation) -> bool:
        if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
            return self._is_extreme(relation, sighting)
        anchors = self._others(relation, sighting)
        return any(self._geometry.holds(relation.predicate, sighting, anchor) for anchor in anchors)

    def _is_extreme(self, relation: Relation, sighting: Observation) -> bool:
        """Of all firm candidates, only the one whose surface is least (most) apart from that of its nearest anchor."""
        sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
        anchors = self._credible(relation.anchor)
        best, least_m = None, np.inf
        for candidate in self._firm(relation.target):
            to_anchors_m = [apart_m(candidate, each) for each in anchors if each is not candidate]
            if to_anchors_m and sign * min(to_anchors_m) < least_m:
                best, least_m = candidate, sign * min(to_anchors_m)
        return best is not None and best.matches(sighting)

    def _firm(self, phrase: str) -> list[Landmark]:
        """The objects that may decide between all that answer a phrase; the believed ones while there is none."""
        credible = self._credible(phrase)
        return [each for each in credible if self._evidence.is_reliable(each)] or credible

    def _credible(self, phrase: str) -> list[Landmark]:
        """The believed objects that answer a phrase, or all while none is."""
        named = self._memory.named(phrase)
        return [each for each in named if self._evidence.is_confirmed(each)] or named
