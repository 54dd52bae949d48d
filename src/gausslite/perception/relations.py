"""Evaluate spatial predicates between an observed target and its anchors (Sec. III-B.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.task import Predicate, Relation
from gausslite.perception.object_map import Landmark, Observation

_FOOTPRINT_SLACK_M = 0.10
_MAX_SAMPLE = 400
# an object diagonally behind counts as behind, an object beside does not
_MIN_SLOPE = 0.5
# tolerated share of a distance that is stated as about so many metres
_ABOUT = 0.25


@dataclass(frozen=True, slots=True)
class SpatialSettings:
    """Distance limits. near: near_m. on, above, under: on_m horizontally, or over the footprint. Sides: side_m."""

    near_m: float = 1.0
    on_m: float = 0.5
    side_m: float = 2.0

    def __post_init__(self) -> None:
        for name in ("near_m", "on_m", "side_m"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(f"spatial {name}: expected a positive length, got {getattr(self, name)}")


class RelationGeometry:
    """Predicates between one target and one anchor, in a world with a known up axis.

    near and on are the paper's. above equals on; under is its mirror image. inside: within the anchor's footprint and
    height. The four sides are relative to the observing camera: behind is farther away than the anchor's nearest part.
    Without a camera, a side is evaluated as near.
    """

    def __init__(self, up: Float64[ndarray, "3"], settings: SpatialSettings) -> None:
        self._up = up
        self._settings = settings

    def holds(self, predicate: Predicate, observation: Observation, anchor: Landmark) -> bool:
        """Return whether predicate(target, anchor) holds. Superlatives and `between` are evaluated elsewhere."""
        if predicate in (Predicate.ON, Predicate.ABOVE):
            return self._is_over(observation.centroid_m, anchor, 1.0)
        if predicate is Predicate.UNDER:
            return self._is_over(observation.centroid_m, anchor, -1.0)
        if predicate is Predicate.INSIDE:
            return self._is_inside(observation.centroid_m, anchor)
        if predicate in _SIDES and observation.camera_m is not None:
            return self._is_on_side(predicate, observation.centroid_m, observation.camera_m, anchor)
        return distance_m(observation.centroid_m, anchor.centroid_m) < self._settings.near_m

    def is_at_distance(self, relation: Relation, observation: Observation, anchors: Sequence[Landmark]) -> bool:
        """Return True if the distance to the nearest anchor is within the relation's bounds; True without bounds.

        Equal bounds mean "about": a quarter less and a quarter more are accepted.
        """
        low_m, high_m = relation.min_m or 0.0, np.inf if relation.max_m is None else relation.max_m
        if low_m == high_m:
            low_m, high_m = (1.0 - _ABOUT) * low_m, (1.0 + _ABOUT) * high_m
        if not anchors or (low_m == 0.0 and np.isinf(high_m)):
            return bool(anchors)
        nearest_m = min(
            float(np.linalg.norm(each.footprint_m().astype(np.float64) - observation.centroid_m, axis=1).min())
            for each in anchors
        )
        return bool(low_m <= nearest_m <= high_m)

    def with_reach(self, max_m: float | None) -> RelationGeometry:
        """Return these predicates, with sides that reach as far as a stated distance."""
        side_m = max(self._settings.side_m, (1.0 + _ABOUT) * (max_m or 0.0))
        return RelationGeometry(self._up, replace(self._settings, side_m=side_m))

    def between(self, observation: Observation, anchors: Sequence[Sequence[Landmark]]) -> bool | None:
        """Return True within near_m of the line between two anchors of different groups; None with fewer than two."""
        pairs = list(combinations(anchors[0], 2)) if len(anchors) == 1 else []
        for one, other in combinations(anchors, 2):
            pairs += product(one, other)
        if not pairs:
            return None
        return any(self._is_between(observation.centroid_m, a.centroid_m, b.centroid_m) for a, b in pairs)

    def _is_over(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark, sign: float) -> bool:
        """Return True above the anchor's centroid (below for sign -1), within on_m of it or over its footprint."""
        height_m, horizontal_m = self._offset_m(centroid_m, anchor.centroid_m[None])
        if sign * height_m[0] <= 0.0:
            return False
        if horizontal_m[0] < self._settings.on_m:
            return True
        _, to_footprint_m = self._offset_m(centroid_m, anchor.footprint_m().astype(np.float64))
        return bool(to_footprint_m.min() < _FOOTPRINT_SLACK_M)

    def _is_inside(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark) -> bool:
        """Return True between the anchor's lowest and highest cells, and within its extent on two horizontal axes."""
        cells = anchor.footprint_m().astype(np.float64)
        height_m, _ = self._offset_m(centroid_m, cells)
        if height_m.max() < -_FOOTPRINT_SLACK_M or height_m.min() > _FOOTPRINT_SLACK_M:
            return False
        across = self._horizontal(np.array((1.0, 0.0, 0.0)) if abs(self._up[0]) < 0.9 else np.array((0.0, 1.0, 0.0)))
        along = np.cross(self._up, across)
        for axis in (across, along):
            extent_m = (cells - centroid_m) @ axis / np.linalg.norm(axis)
            if extent_m.min() > _FOOTPRINT_SLACK_M or extent_m.max() < -_FOOTPRINT_SLACK_M:
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
        _, horizontal_m = self._offset_m(point_m, cells)
        nearest = int(horizontal_m.argmin())
        offset = self._horizontal(
            point_m - (anchor.centroid_m if horizontal_m[nearest] < _FOOTPRINT_SLACK_M else cells[nearest])
        )
        right = np.cross(ahead, self._up)
        behind_m, right_m = float(offset @ ahead) / length_m, float(offset @ right) / length_m
        sign, sideways = _SIDES[predicate]
        along_m, across_m = (right_m, behind_m) if sideways else (behind_m, right_m)
        is_near = float(horizontal_m[nearest]) < self._settings.side_m
        return is_near and sign * along_m > _MIN_SLOPE * abs(across_m)

    def _is_between(
        self, point_m: Float64[ndarray, "3"], a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]
    ) -> bool:
        line = b_m - a_m
        length2 = float(line @ line)
        share = float((point_m - a_m) @ line) / length2 if length2 > 0.0 else 0.0
        return 0.0 < share < 1.0 and distance_m(point_m, a_m + share * line) < self._settings.near_m

    def _horizontal(self, offset_m: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
        horizontal: Float64[ndarray, "3"] = offset_m - (offset_m @ self._up) * self._up
        return horizontal

    def _offset_m(
        self, point_m: Float64[ndarray, "3"], from_m: Float64[ndarray, "n 3"]
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return the height of a point above other points, and its horizontal distance from them."""
        offset = point_m - from_m
        height = offset @ self._up
        return height, np.linalg.norm(offset - height[:, None] * self._up, axis=1)


# the sign of the offset, and whether it is measured sideways (True) or away from the camera (False)
_SIDES = {
    Predicate.BEHIND: (1.0, False),
    Predicate.IN_FRONT_OF: (-1.0, False),
    Predicate.RIGHT_OF: (1.0, True),
    Predicate.LEFT_OF: (-1.0, True),
}


def distance_m(a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]) -> float:
    """Return the Euclidean distance of two points."""
    return float(np.linalg.norm(a_m - b_m))


def surface_distance_m(one: Landmark, other: Landmark) -> float:
    """Return the mean distance of one object's cells to the nearest cells of another.

    Unlike the centroid's distance, it is stable while only a part of a large object has been seen.
    """
    cells, others = (_sample(each.footprint_m(), _MAX_SAMPLE) for each in (one, other))
    squared = np.square(cells[:, None] - others[None]).sum(axis=2)
    return float(np.sqrt(squared.min(axis=1)).mean())


def _sample(cells_m: Float32[ndarray, "n 3"], max_count: int) -> Float64[ndarray, "k 3"]:
    return cells_m[:: -(-len(cells_m) // max_count)].astype(np.float64)
