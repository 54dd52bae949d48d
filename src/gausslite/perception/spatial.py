"""Keep the detections whose place in space fits the task's relations (Sec. III-B.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, lift
from gausslite.domain.pose import UpAxis, transform_points, unit_up_axis
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.memory import ObjectMemory, Remembered, Sighting
from gausslite.perception.relate import Geometry, SpatialSettings, distance_m

_MIN_PIXELS = 8
_MAX_PIXELS = 4000


def best_depth_m(
    sensor_m: Float32[ndarray, "h w"], rendered_m: Float32[ndarray, "h w"] | None
) -> Float32[ndarray, "h w"]:
    """The map's depth where it has drawn something, the sensor's elsewhere."""
    if rendered_m is None or rendered_m.shape != sensor_m.shape:
        return sensor_m
    return np.where(rendered_m > 0, rendered_m, sensor_m)


def sight(
    phrase: str,
    mask: Bool[ndarray, "h w"],
    depth_m: Float32[ndarray, "h w"],
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
) -> Sighting | None:
    """Lift a mask to its centroid in the world; None where too few of its pixels have depth.

    Instead of the one pixel at the 2D centroid, which may lie beside the object, all its pixels are lifted.
    """
    rows, columns = np.nonzero(mask & (depth_m > 0))
    if len(rows) < _MIN_PIXELS:
        return None
    step = max(1, len(rows) // _MAX_PIXELS)
    rows, columns = rows[::step], columns[::step]
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m[rows, columns].astype(np.float64), camera)
    return Sighting.of_points(phrase, transform_points(T_world_camera, points), T_world_camera[:3, 3])


class SpatialFilter:
    """Evaluates the graph's relations against everything seen so far; anchors stay where they were last seen."""

    def __init__(self, graph: TaskGraph, up_axis: UpAxis, settings: SpatialSettings) -> None:
        self._relations = {
            target: tuple(relation for relation in graph.relations if relation.target == target)
            for target in graph.targets
        }
        self._geometry = Geometry(np.array(unit_up_axis(up_axis)), settings)
        self._memory = ObjectMemory()

    @property
    def remembered(self) -> tuple[Remembered, ...]:
        """Every object seen so far, where it was seen on average."""
        return self._memory.objects

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Anchors that some relation needs and no frame has shown yet."""
        needed = dict.fromkeys(each.anchor for relations in self._relations.values() for each in relations)
        return tuple(anchor for anchor in needed if not self._memory.named(anchor))

    def observe(self, sightings: Sequence[Sighting]) -> None:
        """Take one frame's sightings into the memory."""
        self._memory.observe(sightings)

    def remember(self, objects: Sequence[Remembered]) -> None:
        """Start from objects of an earlier life, oldest first."""
        self._memory = ObjectMemory(objects)

    def keep(self, sighting: Sighting) -> bool:
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

    def _others(self, relation: Relation, sighting: Sighting) -> list[Remembered]:
        """The relation's anchors without the target itself."""
        return [each for each in self._memory.named(relation.anchor) if not each.is_at(sighting)]

    def _holds(self, relation: Relation, sighting: Sighting) -> bool:
        if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
            return self._is_extreme(relation, sighting)
        anchors = self._others(relation, sighting)
        return any(self._geometry.holds(relation.predicate, sighting, anchor) for anchor in anchors)

    def _is_extreme(self, relation: Relation, sighting: Sighting) -> bool:
        """Of all candidates that were ever seen, only the one with the least (most) distance to its nearest anchor."""
        sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
        anchors = self._memory.named(relation.anchor)
        best, least_m = None, np.inf
        for candidate in self._memory.confirmed(relation.target):
            to_anchors_m = [
                distance_m(candidate.centroid_m, each.centroid_m) for each in anchors if each is not candidate
            ]
            if to_anchors_m and sign * min(to_anchors_m) < least_m:
                best, least_m = candidate, sign * min(to_anchors_m)
        return best is not None and best.matches(sighting)
