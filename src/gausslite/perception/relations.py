"""Where a target stands to the objects seen so far: the geometry behind each predicate (Sec. III-B.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.task import Predicate
from gausslite.errors import InvalidInputError
from gausslite.perception.object_map import Landmark, Observation

_FOOTPRINT_SLACK_M = 0.10
_MAX_SAMPLE = 400
# what stands slantwise behind is still behind; what stands beside is not
_MIN_SLOPE = 0.5


@dataclass(frozen=True, slots=True)
class SpatialSettings:
    """near: less than near_m away. on, above, under: less than on_m aside, or over the footprint; sides: side_m."""

    near_m: float = 1.0
    on_m: float = 0.5
    side_m: float = 2.0

    def __post_init__(self) -> None:
        for name in ("near_m", "on_m", "side_m"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidInputError(f"spatial {name}: expected a positive length, got {getattr(self, name)}")


class RelationGeometry:
    """Predicates between one target and one anchor, in a world whose up is known.

    near, on: the paper's. above is on; under mirrors it. inside: within the anchor's footprint and height. The four
    sides are those of whoever looks, the camera that made the observation: behind is farther away than the anchor's
    nearest part. Sides of a observation that nobody made are read as near.
    """

    def __init__(self, up: Float64[ndarray, "3"], settings: SpatialSettings) -> None:
        self._up = up
        self._settings = settings

    def holds(self, predicate: Predicate, observation: Observation, anchor: Landmark) -> bool:
        """True where predicate(target, anchor) does; not for superlatives and between, which need more objects."""
        if predicate in (Predicate.ON, Predicate.ABOVE):
            return self._is_over(observation.centroid_m, anchor, 1.0)
        if predicate is Predicate.UNDER:
            return self._is_over(observation.centroid_m, anchor, -1.0)
        if predicate is Predicate.INSIDE:
            return self._is_inside(observation.centroid_m, anchor)
        if predicate in _SIDES and observation.eye_m is not None:
            return self._is_on_side(predicate, observation.centroid_m, observation.eye_m, anchor)
        return distance_m(observation.centroid_m, anchor.centroid_m) < self._settings.near_m

    def between(self, observation: Observation, anchors: Sequence[Sequence[Landmark]]) -> bool | None:
        """Within near_m of the line between two of the anchors, one of each group; None with fewer than two."""
        pairs = list(combinations(anchors[0], 2)) if len(anchors) == 1 else []
        for one, other in combinations(anchors, 2):
            pairs += product(one, other)
        if not pairs:
            return None
        return any(self._is_between(observation.centroid_m, a.centroid_m, b.centroid_m) for a, b in pairs)

    def _is_over(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark, sign: float) -> bool:
        """Higher than the anchor's centroid (lower for sign -1), and less than on_m aside or over its footprint."""
        height_m, aside_m = self._offset_m(centroid_m, anchor.centroid_m[None])
        if sign * height_m[0] <= 0.0:
            return False
        if aside_m[0] < self._settings.on_m:
            return True
        _, beside_m = self._offset_m(centroid_m, anchor.footprint_m().astype(np.float64))
        return bool(beside_m.min() < _FOOTPRINT_SLACK_M)

    def _is_inside(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark) -> bool:
        """Between the anchor's lowest and highest cells, and within its extent along two horizontal axes."""
        cells = anchor.footprint_m().astype(np.float64)
        height_m, _ = self._offset_m(centroid_m, cells)
        if height_m.max() < -_FOOTPRINT_SLACK_M or height_m.min() > _FOOTPRINT_SLACK_M:
            return False
        across = self._level(np.array((1.0, 0.0, 0.0)) if abs(self._up[0]) < 0.9 else np.array((0.0, 1.0, 0.0)))
        along = np.cross(self._up, across)
        for axis in (across, along):
            extent_m = (cells - centroid_m) @ axis / np.linalg.norm(axis)
            if extent_m.min() > _FOOTPRINT_SLACK_M or extent_m.max() < -_FOOTPRINT_SLACK_M:
                return False
        return True

    def _is_on_side(
        self, predicate: Predicate, point_m: Float64[ndarray, "3"], eye_m: Float64[ndarray, "3"], anchor: Landmark
    ) -> bool:
        """On the asked side of the anchor's nearest cell, more so than on another, and less than side_m from it."""
        ahead = self._level(anchor.centroid_m - eye_m)
        length_m = float(np.linalg.norm(ahead))
        if length_m == 0.0:
            return False
        cells = anchor.footprint_m().astype(np.float64)
        _, aside_m = self._offset_m(point_m, cells)
        nearest = int(aside_m.argmin())
        offset = self._level(point_m - (anchor.centroid_m if aside_m[nearest] < _FOOTPRINT_SLACK_M else cells[nearest]))
        right = np.cross(ahead, self._up)
        behind_m, right_m = float(offset @ ahead) / length_m, float(offset @ right) / length_m
        sign, sideways = _SIDES[predicate]
        asked_m, other_m = (right_m, behind_m) if sideways else (behind_m, right_m)
        within = float(aside_m[nearest]) < self._settings.side_m
        return within and sign * asked_m > _MIN_SLOPE * abs(other_m)

    def _is_between(
        self, point_m: Float64[ndarray, "3"], a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]
    ) -> bool:
        line = b_m - a_m
        length2 = float(line @ line)
        share = float((point_m - a_m) @ line) / length2 if length2 > 0.0 else 0.0
        return 0.0 < share < 1.0 and distance_m(point_m, a_m + share * line) < self._settings.near_m

    def _level(self, offset_m: Float64[ndarray, "3"]) -> Float64[ndarray, "3"]:
        level: Float64[ndarray, "3"] = offset_m - (offset_m @ self._up) * self._up
        return level

    def _offset_m(
        self, point_m: Float64[ndarray, "3"], from_m: Float64[ndarray, "n 3"]
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """How much higher, and how far aside horizontally, a point is from others."""
        offset = point_m - from_m
        height = offset @ self._up
        return height, np.linalg.norm(offset - height[:, None] * self._up, axis=1)


# the sign of the offset that is meant, and whether it is measured sideways or away from the eye
_SIDES = {
    Predicate.BEHIND: (1.0, False),
    Predicate.IN_FRONT_OF: (-1.0, False),
    Predicate.RIGHT_OF: (1.0, True),
    Predicate.LEFT_OF: (-1.0, True),
}


def distance_m(a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]) -> float:
    """The Euclidean distance of two points."""
    return float(np.linalg.norm(a_m - b_m))


def surface_distance_m(one: Landmark, other: Landmark) -> float:
    """How far one object's cells lie from the nearest of another's, on average.

    A table of which only an end was seen yet has its centroid elsewhere, but not the edge that a chair stands at.
    """
    cells, others = (_sample(each.footprint_m(), _MAX_SAMPLE) for each in (one, other))
    squared = np.square(cells[:, None] - others[None]).sum(axis=2)
    return float(np.sqrt(squared.min(axis=1)).mean())


def _sample(cells_m: Float32[ndarray, "n 3"], most: int) -> Float64[ndarray, "k 3"]:
    return cells_m[:: -(-len(cells_m) // most)].astype(np.float64)
