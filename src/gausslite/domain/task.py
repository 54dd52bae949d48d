"""The operator's task as a graph of objects and spatial relations (Sec. III-B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Predicate(StrEnum):
    """Spatial predicates of the relation filter; the paper has the first two.

    BETWEEN has one entry per anchor: between(t, a) and between(t, b) form one relation.
    """

    NEAR = "near"
    ON = "on"
    CLOSEST_TO = "closest_to"
    FARTHEST_FROM = "farthest_from"
    UNDER = "under"
    INSIDE = "inside"
    ABOVE = "above"
    BEHIND = "behind"
    IN_FRONT_OF = "in_front_of"
    LEFT_OF = "left_of"
    RIGHT_OF = "right_of"
    BETWEEN = "between"


@dataclass(frozen=True, slots=True)
class Relation:
    """`predicate(target, anchor)`; both are noun phrases of the graph."""

    predicate: Predicate
    target: str
    anchor: str


@dataclass(frozen=True, slots=True)
class TaskGraph:
    """Targets to map in detail, anchors that locate them, and relations r(target, anchor)."""

    task_id: str
    text: str
    targets: tuple[str, ...]
    anchors: tuple[str, ...]
    relations: tuple[Relation, ...]
    warnings: tuple[str, ...] = ()

    def is_equivalent_to(self, other: TaskGraph) -> bool:
        """Return True if targets, anchors and relations are equal; the text may differ."""
        return (self.targets, self.anchors, self.relations) == (other.targets, other.anchors, other.relations)

    @property
    def queries(self) -> tuple[str, ...]:
        """Q = targets ∪ anchors, in order, without duplicates."""
        return tuple(dict.fromkeys((*self.targets, *self.anchors)))
