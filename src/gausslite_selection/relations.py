"""Relations beyond the paper's near and on: sides, inside, under, between, the closest, and distances in metres."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from typing import Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.task import Predicate, Relation
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.selector import (
    FOOTPRINT_SLACK_M,
    TaskObjects,
    anchors_of,
    is_near,
    is_over,
    offset_m,
    sampled,
)

_BETWEEN_M: Final = 1.0
_SIDE_M: Final = 2.0
"""Reach of the four sides."""
_MIN_SIDE_SLOPE: Final = 0.5
"""An object diagonally behind counts as behind, an object beside does not."""
_ABOUT_SHARE: Final = 0.25
"""Tolerated share of a distance that is stated as about so many metres."""
# the sign of the offset, and whether it is measured sideways (True) or away from the camera (False)
_SIDES: Final = {
    Predicate.BEHIND: (1.0, False),
    Predicate.IN_FRONT_OF: (-1.0, False),
    Predicate.RIGHT_OF: (1.0, True),
    Predicate.LEFT_OF: (-1.0, True),
}


def holds(
    relations: Sequence[Relation], observation: Observation, objects: TaskObjects, up: Float64[ndarray, "3"]
) -> bool | None:
    """Return whether one condition of a target holds, as `Selector.holds`."""
    geometry = RelationGeometry(up)
    anchors = [anchors_of(relation, observation, objects) for relation in relations]
    relation = relations[0]
    if relation.predicate is Predicate.BETWEEN:
        return geometry.between(observation, anchors)
    if not objects.seen(relation.anchor):
        return None
    if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
        return _is_extreme(relation, observation, objects)
    if relation.is_bounded:
        if not geometry.is_at_distance(relation, observation, anchors[0]):
            return False
        if relation.predicate is Predicate.NEAR:
            return True
        geometry = geometry.with_reach(relation.max_m)
    return any(geometry.holds(relation.predicate, observation, anchor) for anchor in anchors[0])


def _is_extreme(relation: Relation, observation: Observation, objects: TaskObjects) -> bool:
    """Return True for the candidate with the least (or largest) distance to its nearest anchor."""
    sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
    anchors = objects.confirmed(relation.anchor)
    best, best_signed_m = None, np.inf
    for candidate in objects.candidates(relation.target):
        distances_m = [surface_distance_m(candidate, anchor) for anchor in anchors if anchor is not candidate]
        if distances_m and sign * min(distances_m) < best_signed_m:
            best, best_signed_m = candidate, sign * min(distances_m)
    return best is not None and best.matches(observation)


def surface_distance_m(one: Landmark, other: Landmark) -> float:
    """Return the mean distance of one object's cells to the nearest cells of another.

    Unlike the centroid's distance, it is stable while only a part of a large object has been seen.
    """
    cells, others = (sampled(landmark.footprint_m()) for landmark in (one, other))
    squared = np.square(cells[:, None] - others[None]).sum(axis=2)
    return float(np.sqrt(squared.min(axis=1)).mean())


class RelationGeometry:
    """Predicates between one target and one anchor, in a world with a known up axis.

    above equals on; under is its mirror image. inside: within the anchor's footprint and height. The four sides are
    relative to the observing camera: behind is farther away than the anchor's nearest part. Without a camera, a side is
    evaluated as near.
    """

    def __init__(self, up: Float64[ndarray, "3"], side_m: float = _SIDE_M) -> None:
        self._up, self._side_m = up, side_m

    def holds(self, predicate: Predicate, observation: Observation, anchor: Landmark) -> bool:
        """Return whether predicate(target, anchor) holds. Superlatives and `between` are evaluated elsewhere."""
        if predicate in (Predicate.ON, Predicate.ABOVE):
            return is_over(observation, anchor, self._up)
        if predicate is Predicate.UNDER:
            return is_over(observation, anchor, self._up, -1.0)
        if predicate is Predicate.INSIDE:
            return self._is_inside(observation.centroid_m, anchor)
        if predicate in _SIDES and observation.camera_m is not None:
            return self._is_on_side(predicate, observation.centroid_m, observation.camera_m, anchor)
        return is_near(observation, anchor, self._up)

    def is_at_distance(self, relation: Relation, observation: Observation, anchors: Sequence[Landmark]) -> bool:
        """Return True if the distance to the nearest anchor is within the relation's bounds; True without bounds.

        Equal bounds mean "about": a quarter less and a quarter more are accepted.
        """
        low_m, high_m = relation.min_m or 0.0, np.inf if relation.max_m is None else relation.max_m
        if low_m == high_m:
            low_m, high_m = (1.0 - _ABOUT_SHARE) * low_m, (1.0 + _ABOUT_SHARE) * high_m
        if not anchors or (low_m == 0.0 and np.isinf(high_m)):
            return bool(anchors)
        nearest_m = min(
            float(np.linalg.norm(anchor.footprint_m().astype(np.float64) - observation.centroid_m, axis=1).min())
            for anchor in anchors
        )
        return bool(low_m <= nearest_m <= high_m)

    def with_reach(self, max_m: float | None) -> RelationGeometry:
        """Return these predicates, with sides that reach as far as a stated distance."""
        side_m = max(self._side_m, (1.0 + _ABOUT_SHARE) * (max_m or 0.0))
        return RelationGeometry(self._up, side_m)

    def between(self, observation: Observation, anchors: Sequence[Sequence[Landmark]]) -> bool | None:
        """Return True within _BETWEEN_M of the line between two anchors of different groups; None without two."""
        pairs = list(combinations(anchors[0], 2)) if len(anchors) == 1 else []
        for one, other in combinations(anchors, 2):
            pairs += product(one, other)
        if not pairs:
            return None
        return any(self._is_between(observation.centroid_m, a.centroid_m, b.centroid_m) for a, b in pairs)

    def _is_inside(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark) -> bool:
        """Return True between the anchor's lowest and highest cells, and within its extent on two horizontal axes."""
        cells = anchor.footprint_m().astype(np.float64)
        height_m, _ = offset_m(centroid_m, cells, self._up)
        if height_m.max() < -FOOTPRINT_SLACK_M or height_m.min() > FOOTPRINT_SLACK_M:
            return False
        across = self._horizontal(np.array((1.0, 0.0, 0.0)) if abs(self._up[0]) < 0.9 else np.array((0.0, 1.0, 0.0)))
        along = np.cross(self._up, across)
        for axis in (across, along):
            extent_m = (cells - centroid_m) @ axis / np.linalg.norm(axis)
            if extent_m.min() > FOOTPRINT_SLACK_M or extent_m.max() < -FOOTPRINT_SLACK_M:
                return False
        return True

    def _is_on_side(
        self, predicate: Predicate, point_m: Float64[ndarray, "3"], camera_m: Float64[ndarray, "3"], anchor: Landmark
    ) -> bool:
        """Return True on this side of the anchor's nearest cell, more than on another side, and within side_m of it."""
        ahead = self._horizontal(anchor.centroid_m - camera_m)
        length_m = float(np.linalg.norm(ahead))
        if length_m == 0.0:
            return False
        cells = anchor.footprint_m().astype(np.float64)
        _, horizontal_m = offset_m(point_m, cells, self._up)
        nearest = int(horizontal_m.argmin())
        offset = self._horizontal(
            point_m - (anchor.centroid_m if horizontal_m[nearest] < FOOTPRINT_SLACK_M else cells[nearest])
        )
        right = np.cross(ahead, self._up)
        behind_m, right_m = float(offset @ ahead) / length_m, float(offset @ right) / length_m
        sign, sideways = _SIDES[predicate]
        along_m, across_m = (right_m, behind_m) if sideways else (behind_m, right_m)
        is_near = float(horizontal_m[nearest]) < self._side_m
        return is_near and sign * along_m > _MIN_SIDE_SLOPE * abs(across_m)

    def _is_between(
        self, point_m: Float64[ndarray, "3"], a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]
    ) -> bool:
        line = b_m - a_m
        length2 = float(line @ line)
        share = float((point_m - a_m) @ line) / length2 if length2 > 0.0 else 0.0
        return 0.0 < share < 1.0 and bool(np.linalg.norm(point_m - (a_m + share * line)) < _BETWEEN_M)

    def _horizontal(self, offset_m: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
        horizontal: Float64[ndarray, "3"] = offset_m - (offset_m @ self._up) * self._up
        return horizontal
