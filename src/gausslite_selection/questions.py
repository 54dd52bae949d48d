"""Answer a question about a finished map's objects, with the graph and the relations of a task.

`answer` is the default plug-in of the group `gausslite.questions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.objects import Answer, ObjectLandmark
from gausslite.domain.pose import UpAxis, unit_up_axis
from gausslite.domain.task import Predicate, Relation, Superlative, TaskGraph, noun_of
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.nouns import meant_by
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relations import RelationFilter
from gausslite.perception.selector import TaskObjects, anchors_of, is_over
from gausslite_selection.left_out import left_out_note
from gausslite_selection.selector import AttributeSelector

_BOX_STEP_M = 0.05
_MAX_STEPS = 16
_OVER_SHARE = 0.5
"""Of the smaller footprint. A box of a couch has its seat at half its height, and all of a cushion over it."""
_OF_A_VIEWPOINT = (Superlative.NEAREST, Superlative.FARTHEST, Superlative.LEFTMOST, Superlative.RIGHTMOST)


def answer(
    graph: TaskGraph,
    objects: Sequence[ObjectLandmark],
    up_axis: UpAxis = (0.0, 0.0, 1.0),
    T_world_camera: Float64[ndarray, "4 4"] | None = None,
) -> Answer:
    """Return the objects that are targets of the graph, as a robot with this task would choose them from their boxes.

    Unlike a task, a relation to an anchor that the map does not have selects nothing. T_world_camera: the viewpoint of
    left_of, nearest and the like; without it, sides are evaluated as near.
    """
    mapped, selector = _MappedObjects(objects), _BoxSelector(graph, (), np.array(unit_up_axis(up_axis)))
    selector.mapped = mapped
    relations = RelationFilter(graph, mapped, selector)
    notes = [f"the map has no {noun_of(name)!r}" for name in relations.unseen_anchors]
    if notes:
        return Answer((), tuple(notes))
    superlatives = {attribute.name: attribute.superlative for attribute in graph.attributes if attribute.superlative}
    notes += [
        f"the map does not store colours: {attribute.colour!r} is not evaluated"
        for attribute in graph.attributes
        if attribute.colour is not None
    ]
    chosen: list[Landmark] = []
    for target in graph.targets:
        left_out = _left_out(graph, target, mapped)
        seen = [landmark for landmark in mapped.seen(target) if landmark.number not in left_out]
        camera_m = None if T_world_camera is None else T_world_camera[:3, 3]
        observed = [replace(landmark.seen_from(np.zeros(3)), camera_m=camera_m) for landmark in seen]
        fitting = [
            thing for thing, seen_now in zip(seen, observed, strict=True) if relations.satisfies(target, seen_now)
        ]
        notes += filter(None, [left_out_note(graph, target, observed, selector, mapped)])
        superlative = superlatives.get(target)
        if fitting and superlative is not None:
            if superlative in _OF_A_VIEWPOINT and T_world_camera is None:
                notes.append(f"{superlative}: needs a viewpoint, which this map does not have")
                continue
            pose = np.eye(4) if T_world_camera is None else T_world_camera
            fitting = selector.select(target, fitting, pose)
        chosen += fitting
    numbers = sorted({landmark.number for landmark in chosen})
    return Answer(tuple(objects[number] for number in numbers), tuple(notes))


def _left_out(graph: TaskGraph, target: str, mapped: _MappedObjects) -> set[int]:
    """Return the numbers of excluded objects, and of the anchors: a chair is not what is near the chair."""
    noun = noun_of(target)
    anchors = [relation.anchor for relation in graph.relations if relation.target == target]
    others = [anchor for anchor in anchors if noun_of(anchor) != noun]
    return {landmark.number for name in (*graph.excluded, *others) for landmark in mapped.seen(name)}


class _MappedObjects:
    """The objects of a finished map as landmarks, all of them confirmed; a landmark's number is its position."""

    def __init__(self, objects: Sequence[ObjectLandmark]) -> None:
        self._landmarks = [mapped_landmark(number, found) for number, found in enumerate(objects)]

    def shown_by(self, observation: Observation) -> MappedLandmark:
        """Return the object of an observation."""
        return next(landmark for landmark in self._landmarks if landmark.may_equal(observation))

    def seen(self, name: str) -> list[Landmark]:
        """Return the objects that a name of the graph means, by noun and synonym."""
        nouns = set(meant_by(noun_of(name), dict.fromkeys(landmark.phrase for landmark in self._landmarks)))
        return [landmark for landmark in self._landmarks if landmark.phrase in nouns]

    def confirmed(self, name: str) -> list[Landmark]:
        """Return the same: a map lists confirmed objects only."""
        return self.seen(name)

    def candidates(self, name: str) -> list[Landmark]:
        """Return the same."""
        return self.seen(name)


class MappedLandmark(Landmark):
    """A listed object. Another one is never the same, however near."""

    box: AxisAlignedBox

    def may_equal(self, other: Observation | Landmark) -> bool:
        """Return True for itself and its own observations, which share its centroid."""
        return other.centroid_m is self.centroid_m

    matches = may_equal


class _BoxSelector(AttributeSelector):
    """Decides what is on another by whole boxes; a task must by what its frames have shown so far."""

    mapped: _MappedObjects

    def holds(self, relations: Sequence[Relation], observation: Observation, objects: TaskObjects) -> bool | None:
        """Return whether a condition holds."""
        holds, relation = super().holds(relations, observation, objects), relations[0]
        if not holds or relation.predicate not in (Predicate.ON, Predicate.ABOVE):
            return holds
        one, anchors = self.mapped.shown_by(observation), anchors_of(relation, observation, objects)
        return any(is_on(one, anchor, self._up) for anchor in anchors if isinstance(anchor, MappedLandmark))


def is_on(one: MappedLandmark, other: MappedLandmark, up: Float64[ndarray, "3"]) -> bool:
    """Return True for an object over another, unless it is beside it.

    That is, it begins below the middle of the other's height, and less than half of the smaller footprint is shared.
    """
    if not is_over(one.seen_from(np.zeros(3)), other, up):
        return False
    axis = int(np.argmax(np.abs(up)))
    boxes = [np.array((landmark.box.min_m, landmark.box.max_m)) for landmark in (one, other)]
    (lower_m, upper_m), (other_lower_m, other_upper_m) = boxes
    shared_m = np.delete(np.minimum(upper_m, other_upper_m) - np.maximum(lower_m, other_lower_m), axis)
    least_m2 = min(float(np.delete(high_m - low_m, axis).prod()) for low_m, high_m in boxes)
    bottom_m, middle_m = np.sign(up[axis]) * boxes[0][:, axis], np.sign(up[axis]) * boxes[1][:, axis].mean()
    return bool(bottom_m.min() >= middle_m or np.maximum(shared_m, 0.0).prod() >= _OVER_SHARE * least_m2)


def mapped_landmark(number: int, found: ObjectLandmark) -> MappedLandmark:
    """Return a landmark whose cells fill the object's box."""
    low_m, high_m = np.array(found.extent_m.min_m), np.array(found.extent_m.max_m)
    steps = np.clip(np.ceil((high_m - low_m) / _BOX_STEP_M).astype(int) + 1, 2, _MAX_STEPS)
    axes = [np.linspace(low_m[axis], high_m[axis], steps[axis]) for axis in range(3)]
    points_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    landmark = MappedLandmark.from_observation(Observation.from_points(found.noun, points_m, score=found.confidence))
    landmark.number, landmark.centroid_m, landmark.box = number, np.array(found.centroid_m), found.extent_m
    return landmark
