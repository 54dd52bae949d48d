"""What the names of a task mean beyond their nouns: relations near and on; plug-ins add others, and attributes."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.state import State
from gausslite.domain.task import Predicate, Relation, TaskGraph, noun_of
from gausslite.domain.voxels import VoxelGrid
from gausslite.perception.object_map import CELL_M, Landmark, Measured, Observation
from gausslite.plugins import Group, find, load

_NEAR_M: Final = 0.75
"""Between surfaces. Of 724 pairs of things in homes with centroids within a metre, 705 are near."""
_ON_M: Final = 0.5
FOOTPRINT_SLACK_M: Final = 0.10
"""Horizontal distance at which an object is still over a footprint."""
_MAX_SAMPLED_CELLS: Final = 400


class Fit(Enum):
    """Whether an object has the attributes of a name."""

    YES = "yes"
    DOUBTFUL = "doubtful"
    NO = "no"


@runtime_checkable
class TaskObjects(Protocol):
    """The landmarks that the names of a task mean."""

    def seen(self, name: str) -> list[Landmark]:
        """Return all landmarks of a name."""

    def confirmed(self, name: str) -> list[Landmark]:
        """Return the confirmed landmarks of a name; if there are none, all of them."""

    def candidates(self, name: str) -> list[Landmark]:
        """Return those of which one can be the closest or the farthest."""


class Selector:
    """Tells objects of one noun apart: this one by the paper's relations, whatever their attributes.

    A plug-in of `gausslite.selectors` is a class derived from it. A task that needs one fails without it.
    """

    def __init__(self, graph: TaskGraph, matches: Sequence[NounMatch], up: Float64[ndarray, "3"]) -> None:
        """matches: what the detector searches for the graph's nouns. up: the world's upward direction."""
        self._up, self.places = up, {match.noun: match.is_there for match in matches}

    def observe(self, frame: Frame) -> None:
        """Measure what all objects need, such as the floor's level, on a frame with detections."""

    def measured(self, observation: Observation, mask: Bool[ndarray, "h w"], frame: Frame) -> Measured | None:
        """Return what a detection's mask shows of its attributes."""
        return None

    def fit(self, name: str, measured: Measured | None) -> Fit:
        """Return whether an object has the attributes of a name; YES for a name without any."""
        return Fit.YES

    def is_excluded(self, noun: str, measured: Measured | None) -> bool:
        """Return True if an object of a target's noun surely has the attributes of an excluded object of this noun."""
        return False

    def decides(self, relation: Relation) -> bool:
        """Return True if attributes of the target decide a relation, because nothing detects its anchor."""
        return False

    def holds(self, relations: Sequence[Relation], observation: Observation, objects: TaskObjects) -> bool | None:
        """Return whether one condition of a target holds, regardless of its negation; None if it cannot be evaluated.

        It has one relation, or `between` with all its anchors.
        """
        (relation,) = relations
        if not objects.seen(relation.anchor):
            return None
        holds = is_near if relation.predicate is Predicate.NEAR else is_over
        return any(holds(observation, anchor, self._up) for anchor in anchors_of(relation, observation, objects))

    def select(self, target: str, landmarks: list[Landmark], T_world_camera: Float64[ndarray, "4 4"]) -> list[Landmark]:
        """Return those of a target's landmarks that its superlative selects, seen from T_world_camera."""
        return landmarks

    def label(self, name: str) -> str:
        """Return the noun of a name with its attributes, for people."""
        return noun_of(name)

    def notes(self, confirmed: Sequence[Landmark], objects: TaskObjects) -> tuple[str, ...]:
        """Return what attributes decided, a line each."""
        return ()

    def state(self) -> State:
        """Return what `observe` has measured."""
        return {}

    def restore(self, state: State) -> None:
        """Replace what `observe` has measured by a state that has it among others. Raises MapFileError."""

    def decode(self, state: State) -> Measured | None:
        """Return what was measured of one object from a state that has it among others. Raises MapFileError."""
        return None


def open_selector(graph: TaskGraph, matches: Sequence[NounMatch], up: Float64[ndarray, "3"]) -> Selector:
    """Return the installed selector for a task. Raises MissingPluginError without one if the task needs it."""
    selector: type[Selector] | None = find(Group.SELECTORS)
    if selector is None:
        needs = [f"task attribute of {noun_of(attributes.name)!r}" for attributes in graph.attributes]
        needs += [
            f"task relation {relation}"
            for relation in graph.relations
            if relation.predicate not in (Predicate.NEAR, Predicate.ON) or relation.is_bounded
        ]
        selector = load(Group.SELECTORS, purpose=needs[0]) if needs else Selector
    return selector(graph, matches, up)


def anchors_of(relation: Relation, observation: Observation, objects: TaskObjects) -> list[Landmark]:
    """Return the relation's anchors without the target itself."""
    return [anchor for anchor in objects.confirmed(relation.anchor) if not anchor.may_equal(observation)]


def is_near(observation: Observation, anchor: Landmark, up: Float64[ndarray, "3"]) -> bool:
    """Return True for near(target, anchor) of the paper, between the nearest cells instead of the centroids.

    A chair at the end of a long table is near it.
    """
    del up
    footprint_m = anchor.footprint_m().astype(np.float64)
    cells_m = sampled(VoxelGrid(CELL_M).centres_m(observation.cells))
    return min(float(np.linalg.norm(footprint_m - cell_m, axis=1).min()) for cell_m in cells_m) < _NEAR_M


def is_over(observation: Observation, anchor: Landmark, up: Float64[ndarray, "3"], sign: float = 1.0) -> bool:
    """Return True for on(target, anchor): above the anchor's centroid (below for sign -1), within 0.5 m of it or over
    its footprint.

    Over the footprint, an object above all cells near it is above the anchor too: an upward direction with an error of
    a degree lowers the far end of a table of a metre by two centimetres.
    """
    height_m, horizontal_m = offset_m(observation.centroid_m, anchor.centroid_m[None], up)
    is_beyond = sign * height_m[0] > 0.0
    if is_beyond and horizontal_m[0] < _ON_M:
        return True
    to_cell_m, to_footprint_m = offset_m(observation.centroid_m, anchor.footprint_m().astype(np.float64), up)
    is_close = to_footprint_m < FOOTPRINT_SLACK_M
    return bool(is_close.any() and (is_beyond or (sign > 0 and to_cell_m[is_close].min() > 0.0)))


def offset_m(
    point_m: Float64[ndarray, "3"], from_m: Float64[ndarray, "n 3"], up: Float64[ndarray, "3"]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the height of a point above other points, and its horizontal distance from them."""
    offset = point_m - from_m
    height = offset @ up
    return height, np.linalg.norm(offset - height[:, None] * up, axis=1)


def sampled(cells_m: Float32[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Return at most 400 of the points."""
    return cells_m[:: -(-len(cells_m) // _MAX_SAMPLED_CELLS)].astype(np.float64)
