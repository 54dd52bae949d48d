"""Evaluate the relations of a target on all objects seen so far (Sec. III-B.3), and superlatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.task import Predicate, Relation, Superlative, TaskGraph, noun_of
from gausslite.domain.voxels import VoxelGrid
from gausslite.perception.colours import ColourFilter
from gausslite.perception.evidence import Evidence
from gausslite.perception.object_map import CELL_M, Landmark, ObjectMap, Observation

_NEAR_M = 0.75
"""Between surfaces. Of 724 pairs of things in homes with centroids within a metre, 705 are near."""
_BETWEEN_M = 1.0
_ON_M = 0.5
_SIDE_M = 2.0
"""Reach of the four sides."""
_FOOTPRINT_SLACK_M = 0.10
"""Horizontal distance at which an object is still over a footprint."""
_MIN_SIDE_SLOPE = 0.5
"""An object diagonally behind counts as behind, an object beside does not."""
_ABOUT_SHARE = 0.25
"""Tolerated share of a distance that is stated as about so many metres."""
_MAX_SAMPLED_CELLS = 400


@runtime_checkable
class TaskObjects(Protocol):
    """The landmarks that the names of a task mean."""

    def seen(self, name: str) -> list[Landmark]:
        """Return all landmarks of a name."""
        ...

    def confirmed(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks of a name; if there are none, all of them."""
        ...

    def candidates(self, name: str) -> list[Landmark]:
        """Return those of which one can be the closest or the farthest."""
        ...


@runtime_checkable
class Surfaces(Protocol):
    """Decides by heights whether an object stands on an anchor."""

    def is_by_height(self, relation: Relation) -> bool:
        """Return True if heights decide the relation."""
        ...

    def stands_on(self, relation: Relation, seen: Landmark | Observation) -> bool | None:
        """Return whether an object stands on the relation's anchor by its height; None if heights do not decide."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class NamedObjects:
    """The landmarks that the names of a task mean: of a name's noun, without those of another colour."""

    object_map: ObjectMap
    evidence: Evidence
    colours: ColourFilter

    def seen(self, name: str) -> list[Landmark]:
        """Return all landmarks of a name."""
        return [
            landmark
            for landmark in self.object_map.with_phrase(noun_of(name))
            if self.colours.allows(name, landmark.colours)
        ]

    def confirmed(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks of a name; if there are none, all of them."""
        seen = self.seen(name)
        confirmed = self.evidence.confirmed(self.object_map.objects)
        return [landmark for landmark in seen if any(landmark is other for other in confirmed)] or seen

    def candidates(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks without those of far lower scores: one false candidate decides."""
        return self.evidence.without_low_scores(self.confirmed(name))


class RelationFilter:
    """Decides whether an observed object satisfies the relations of a target, to objects in view or not."""

    def __init__(
        self, graph: TaskGraph, up: Float64[ndarray, "3"], objects: TaskObjects,
        surfaces: Surfaces,
    ) -> None:  # fmt: skip
        """Objects and surfaces are shared with their owner, which observes frames."""
        self._relations = {
            target: tuple(relation for relation in graph.relations if relation.target == target)
            for target in graph.targets
        }
        self._geometry = RelationGeometry(up)
        self._objects = objects
        self._surfaces = surfaces

    @property
    def unseen_anchors(self) -> tuple[str, ...]:
        """Names of anchors that no frame has shown yet."""
        relations = [relation for of_target in self._relations.values() for relation in of_target]
        needed = dict.fromkeys(relation.anchor for relation in relations if not self._surfaces.is_by_height(relation))
        return tuple(name for name in needed if not self._objects.seen(name))

    def satisfies(self, target: str, observation: Observation) -> bool:
        """Return True if no negated relation holds, and any other does (Sec. III-B.3) or none can be evaluated.

        Relations to anchors that were never seen in their colour are not evaluated. Of negated relations that heights
        decide, only the sure ones hold. All the anchors of `between` form one relation.
        """
        relations = self._relations[target]
        evaluated = [
            relation
            for relation in relations
            if self._surfaces.stands_on(relation, observation) is not None or self._objects.seen(relation.anchor)
        ]
        if any(
            relation.negated and self._surfaces.is_by_height(relation) and relation not in evaluated
            for relation in relations
        ):
            return False
        simple = [relation for relation in evaluated if relation.predicate is not Predicate.BETWEEN]
        if any(relation.negated and self._holds(relation, observation) for relation in simple):
            return False
        if self._is_between(relations, observation, negated=True):
            return False
        results = [self._holds(relation, observation) for relation in simple if not relation.negated]
        between = self._is_between(relations, observation, negated=False)
        if between is not None:
            results.append(between)
        return not results or any(results)

    def _is_between(self, relations: Sequence[Relation], observation: Observation, negated: bool) -> bool | None:
        """Return whether an object is between the anchors of these relations; None if this cannot be evaluated."""
        anchors = [
            self._anchors(relation, observation)
            for relation in relations
            if relation.predicate is Predicate.BETWEEN and relation.negated == negated
        ]
        return self._geometry.between(observation, anchors) if anchors else None

    def _anchors(self, relation: Relation, observation: Observation) -> list[Landmark]:
        """Return the relation's anchors without the target itself."""
        return [anchor for anchor in self._objects.confirmed(relation.anchor) if not anchor.may_equal(observation)]

    def _holds(self, relation: Relation, observation: Observation) -> bool:
        """Return whether the relation holds, regardless of its negation."""
        by_height = self._surfaces.stands_on(relation, observation)
        if by_height is not None:
            return by_height
        if relation.predicate in (Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM):
            return self._is_extreme(relation, observation)
        anchors = self._anchors(relation, observation)
        has_bounds = relation.min_m is not None or relation.max_m is not None
        if has_bounds and not self._geometry.is_at_distance(relation, observation, anchors):
            return False
        if has_bounds and relation.predicate is Predicate.NEAR:
            return True
        geometry = self._geometry.with_reach(relation.max_m) if has_bounds else self._geometry
        return any(geometry.holds(relation.predicate, observation, anchor) for anchor in anchors)

    def _is_extreme(self, relation: Relation, observation: Observation) -> bool:
        """Return True for the candidate with the least (or largest) distance to its nearest anchor."""
        sign = 1.0 if relation.predicate is Predicate.CLOSEST_TO else -1.0
        anchors = self._objects.confirmed(relation.anchor)
        best, best_signed_m = None, np.inf
        for candidate in self._objects.candidates(relation.target):
            distances_m = [
                surface_distance_m(candidate, anchor, _MAX_SAMPLED_CELLS)
                for anchor in anchors
                if anchor is not candidate
            ]
            if distances_m and sign * min(distances_m) < best_signed_m:
                best, best_signed_m = candidate, sign * min(distances_m)
        return best is not None and best.matches(observation)


class RelationGeometry:
    """Predicates between one target and one anchor, in a world with a known up axis.

    near: the paper's, between surfaces instead of centroids: a chair at the end of a long table is near it. on is the
    paper's. above equals on; under is its mirror image. inside: within the anchor's footprint and height. The four
    sides are relative to the observing camera: behind is farther away than the anchor's nearest part. Without a camera,
    a side is evaluated as near.
    """

    def __init__(self, up: Float64[ndarray, "3"], side_m: float = _SIDE_M) -> None:
        self._up, self._side_m = up, side_m

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
        return self._gap_m(observation, anchor) < _NEAR_M

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

    def _gap_m(self, observation: Observation, anchor: Landmark) -> float:
        """Return the distance between the nearest cells of an object and an anchor."""
        cells_m = VoxelGrid(CELL_M).centres_m(observation.cells)
        cells = _sample(cells_m, _MAX_SAMPLED_CELLS)
        footprint = anchor.footprint_m().astype(np.float64)
        return min(float(np.linalg.norm(footprint - cell, axis=1).min()) for cell in cells)

    def with_reach(self, max_m: float | None) -> RelationGeometry:
        """Return these predicates, with sides that reach as far as a stated distance."""
        side_m = max(self._side_m, (1.0 + _ABOUT_SHARE) * (max_m or 0.0))
        return RelationGeometry(self._up, side_m)

    def between(self, observation: Observation, anchors: Sequence[Sequence[Landmark]]) -> bool | None:
        """Return True within between_m of the line between two anchors of different groups; None without two."""
        pairs = list(combinations(anchors[0], 2)) if len(anchors) == 1 else []
        for one, other in combinations(anchors, 2):
            pairs += product(one, other)
        if not pairs:
            return None
        return any(self._is_between(observation.centroid_m, a.centroid_m, b.centroid_m) for a, b in pairs)

    def _is_over(self, centroid_m: Float64[ndarray, "3"], anchor: Landmark, sign: float) -> bool:
        """Return True above the anchor's centroid (below for sign -1), within on_m of it or over its footprint.

        Over the footprint, an object above all cells near it is above the anchor too: an upward direction with an error
        of a degree lowers the far end of a table of a metre by two centimetres.
        """
        height_m, horizontal_m = self._offset_m(centroid_m, anchor.centroid_m[None])
        is_beyond = sign * height_m[0] > 0.0
        if is_beyond and horizontal_m[0] < _ON_M:
            return True
        to_cell_m, to_footprint_m = self._offset_m(centroid_m, anchor.footprint_m().astype(np.float64))
        is_near = to_footprint_m < _FOOTPRINT_SLACK_M
        return bool(is_near.any() and (is_beyond or (sign > 0 and to_cell_m[is_near].min() > 0.0)))

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
        is_near = float(horizontal_m[nearest]) < self._side_m
        return is_near and sign * along_m > _MIN_SIDE_SLOPE * abs(across_m)

    def _is_between(
        self, point_m: Float64[ndarray, "3"], a_m: Float64[ndarray, "3"], b_m: Float64[ndarray, "3"]
    ) -> bool:
        line = b_m - a_m
        length2 = float(line @ line)
        share = float((point_m - a_m) @ line) / length2 if length2 > 0.0 else 0.0
        return 0.0 < share < 1.0 and distance_m(point_m, a_m + share * line) < _BETWEEN_M

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


def surface_distance_m(one: Landmark, other: Landmark, max_cells: int) -> float:
    """Return the mean distance of one object's cells to the nearest cells of another.

    Unlike the centroid's distance, it is stable while only a part of a large object has been seen.
    """
    cells, others = (_sample(landmark.footprint_m(), max_cells) for landmark in (one, other))
    squared = np.square(cells[:, None] - others[None]).sum(axis=2)
    return float(np.sqrt(squared.min(axis=1)).mean())


def _sample(cells_m: Float32[ndarray, "n 3"], max_count: int) -> Float64[ndarray, "k 3"]:
    return cells_m[:: -(-len(cells_m) // max_count)].astype(np.float64)


Measure = Callable[[Landmark, Float64[ndarray, "3"], Float64[ndarray, "4 4"]], float]


def select_extreme(
    landmarks: Sequence[Landmark],
    superlative: Superlative,
    up: Float64[ndarray, "3"],
    T_world_camera: Float64[ndarray, "4 4"],
) -> Landmark:
    """Return the landmark, of at least one of a noun, with the extreme value, seen from T_world_camera if needed."""
    measure, sign = _MEASURES[superlative]
    return max(landmarks, key=lambda landmark: sign * measure(landmark, up, T_world_camera))


def _diagonal_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up, T_world_camera
    return float(np.linalg.norm(_extents_m(landmark, np.eye(3))))


def _height_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del T_world_camera
    return float(_extents_m(landmark, up[None])[0])


def _width_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the larger horizontal extent."""
    del T_world_camera
    return float(_horizontal_extents_m(landmark, up).max())


def _thickness_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    """Return the smallest extent."""
    return float(min(_horizontal_extents_m(landmark, up).min(), _height_m(landmark, up, T_world_camera)))


def _level_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del T_world_camera
    return float(landmark.centroid_m @ up)


def _distance_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up
    return float(np.linalg.norm(landmark.centroid_m - T_world_camera[:3, 3]))


def _rightness_m(landmark: Landmark, up: Float64[ndarray, "3"], T_world_camera: Float64[ndarray, "4 4"]) -> float:
    del up
    return float(transform_points(inverse(T_world_camera), landmark.centroid_m[None])[0, 0])


def _horizontal_extents_m(landmark: Landmark, up: Float64[ndarray, "3"]) -> Float64[ndarray, "2"]:
    across = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    across /= np.linalg.norm(across)
    return _extents_m(landmark, np.stack([across, np.cross(up, across)]))


def _extents_m(landmark: Landmark, axes: Float64[ndarray, "a 3"]) -> Float64[ndarray, " a"]:
    """Return the extent of the landmark's cells along each axis."""
    along_m: Float64[ndarray, "k a"] = landmark.footprint_m().astype(np.float64) @ axes.T
    extents: Float64[ndarray, " a"] = np.ptp(along_m, axis=0)
    return extents


_MEASURES: Final[Mapping[Superlative, tuple[Measure, float]]] = {
    Superlative.LARGEST: (_diagonal_m, 1.0),
    Superlative.SMALLEST: (_diagonal_m, -1.0),
    Superlative.TALLEST: (_height_m, 1.0),
    Superlative.SHORTEST: (_height_m, -1.0),
    Superlative.LONGEST: (_width_m, 1.0),
    Superlative.WIDEST: (_width_m, 1.0),
    Superlative.NARROWEST: (_width_m, -1.0),
    Superlative.THICKEST: (_thickness_m, 1.0),
    Superlative.THINNEST: (_thickness_m, -1.0),
    Superlative.HIGHEST: (_level_m, 1.0),
    Superlative.LOWEST: (_level_m, -1.0),
    Superlative.RIGHTMOST: (_rightness_m, 1.0),
    Superlative.LEFTMOST: (_rightness_m, -1.0),
    Superlative.FARTHEST: (_distance_m, 1.0),
    Superlative.NEAREST: (_distance_m, -1.0),
}
