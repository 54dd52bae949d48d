"""Name the relations that leave out every object of a target: "2 'mug' seen, none on the 'table'"."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.object_map import Observation
from gausslite.perception.relations import RelationFilter, conditions_of
from gausslite.perception.selector import Selector, TaskObjects, anchors_of

_TOUCHING_M = 0.05  # no distance to speak of
_WITHOUT_DISTANCE = (Predicate.BETWEEN, Predicate.CLOSEST_TO, Predicate.FARTHEST_FROM)


def left_out_note(
    graph: TaskGraph, target: str, seen: Sequence[Observation], selector: Selector, objects: TaskObjects
) -> str | None:
    """Return a line if the relations of a target leave out all objects of its noun and attributes, else None."""
    relations = RelationFilter(graph, objects, selector)
    if not seen or any(relations.satisfies(target, thing) for thing in seen):
        return None
    reasons = []
    for condition in conditions_of(graph, target):
        relation, place = condition[0], _place(condition, selector)
        results = [selector.holds(condition, thing, objects) for thing in seen]
        if relation.negated:
            count = sum(bool(holds) or (holds is None and selector.decides(relation)) for holds in results)
            reasons += [f"{count} {place}, which the task excludes"] if count else []
        elif False in results:
            count = results.count(True)
            reasons.append(f"only {count} {place}" if count else f"none {place}{_nearest(relation, seen, objects)}")
    return f"{len(seen)} {selector.label(target)!r} seen, {'; '.join(reasons)}"


def _place(condition: Sequence[Relation], selector: Selector) -> str:
    """Return a condition for people: "near the 'door', at most 2 m"."""
    relation = condition[0]
    anchors = " and ".join(f"the {selector.label(relation.anchor)!r}" for relation in condition)
    low_m, high_m = relation.min_m, relation.max_m
    bounds = [f"at least {low_m:g} m"] if low_m is not None else []
    bounds += [f"at most {high_m:g} m"] if high_m is not None else []
    bounds = [f"about {low_m:g} m"] if low_m is not None and low_m == high_m else bounds
    return ", ".join((f"{relation.predicate.replace('_', ' ')} {anchors}", *bounds))


def _nearest(relation: Relation, seen: Sequence[Observation], objects: TaskObjects) -> str:
    """Return how far the nearest object's centroid is from an anchor, to 0.1 m: a note that changes is a new one."""
    distances_m = [
        float(np.linalg.norm(anchor.footprint_m().astype(np.float64) - thing.centroid_m, axis=1).min())
        for thing in seen
        for anchor in anchors_of(relation, thing, objects)
    ]
    nearest_m = min(distances_m, default=0.0)
    if nearest_m < _TOUCHING_M or relation.predicate in _WITHOUT_DISTANCE:
        return ""
    return f": the nearest is {nearest_m:.1f} m away"
