"""Keep the detections whose place in space fits the task's relations (Sec. III-B.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, lift
from gausslite.domain.pose import UpAxis, transform_points, unit_up_axis
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.perception.memory import ObjectMemory, Remembered, Sighting

_MIN_PIXELS = 8
_MAX_PIXELS = 4000
_FOOTPRINT_SLACK_M = 0.10


@dataclass(frozen=True, slots=True)
class SpatialSettings:
    """near: distance under near_m. on: higher than the anchor, and less than on_m aside or over it."""

    near_m: float = 1.0
    on_m: float = 0.5

    def __post_init__(self) -> None:
        for name in ("near_m", "on_m"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(f"spatial {name}: expected a positive length, got {getattr(self, name)}")


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
    return Sighting.of_points(phrase, transform_points(T_world_camera, points))


class SpatialFilter:
    """Evaluates the graph's relations against everything seen so far; anchors stay where they were last seen."""

    def __init__(self, graph: TaskGraph, up_axis: UpAxis, settings: SpatialSettings) -> None:
        self._relations = {
            target: tuple(relation for relation in graph.relations if relation.target == target)
            for target in graph.targets
        }
        self._settings = settings
        self._up = np.array(unit_up_axis(up_axis))
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
        """
        judged = [each for each in self._relations.get(sighting.phrase, ()) if self._memory.named(each.anchor)]
        return not judged or any(self._holds(relation, sighting) for relation in judged)

    def _holds(self, relation: Relation, sighting: Sighting) -> bool:
        if relation.predicate is Predicate.CLOSEST_TO:
            return self._is_closest(relation, sighting)
        anchors = [each for each in self._memory.named(relation.anchor) if not each.is_at(sighting)]
        if relation.predicate is Predicate.ON:
            return any(self._is_on(sighting.centroid_m, anchor) for anchor in anchors)
        return any(_distance_m(sighting.centroid_m, anchor.centroid_m) < self._settings.near_m for anchor in anchors)

    def _is_on(self, centroid_m: Float64[ndarray, "3"], anchor: Remembered) -> bool:
        """Higher than the anchor's centroid, and less than on_m aside of it or over its footprint."""
        height_m, aside_m = self._offset_m(centroid_m, anchor.centroid_m[None])
        if height_m[0] <= 0.0:
            return False
        if aside_m[0] < self._settings.on_m:
            return True
        _, beside_m = self._offset_m(centroid_m, anchor.footprint_m().astype(np.float64))
        return bool(beside_m.min() < _FOOTPRINT_SLACK_M)

    def _offset_m(
        self, point_m: Float64[ndarray, "3"], from_m: Float64[ndarray, "n 3"]
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """How much higher, and how far aside horizontally, a point is from others."""
        offset = point_m - from_m
        height = offset @ self._up
        return height, np.linalg.norm(offset - height[:, None] * self._up, axis=1)

    def _is_closest(self, relation: Relation, sighting: Sighting) -> bool:
        """Only the candidate with the least distance to an anchor, of all that were ever seen, is the closest."""
        anchors = self._memory.named(relation.anchor)
        best, least_m = None, np.inf
        for candidate in self._memory.confirmed(relation.target):
            for anchor in anchors:
                distance_m = _distance_m(candidate.centroid_m, anchor.centroid_m)
                if candidate is not anchor and distance_m < least_m:
                    best, least_m = candidate, distance_m
        return best is not None and best.matches(sighting)


def _distance_m(a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]) -> float:
    return float(np.linalg.norm(a_m - b_m))
