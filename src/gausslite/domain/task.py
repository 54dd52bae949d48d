"""What the operator asked for, as objects and the relations between them (Sec. III-B.1)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Predicate(StrEnum):
    """Spatial predicates the relation filter can evaluate; the paper has the first two.

    BETWEEN is said once for each of its anchors: between(t, a) and between(t, b) are one relation.
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
    """Targets to map in detail, anchors that locate them, and the relations r(target, anchor)."""

    task_id: str
    text: str
    targets: tuple[str, ...]
    anchors: tuple[str, ...]
    relations: tuple[Relation, ...]
    warnings: tuple[str, ...] = ()

    def is_equivalent_to(self, other: TaskGraph) -> bool:
        """True when both look for the same things in the same relations, whatever the words were."""
        return (self.targets, self.anchors, self.relations) == (other.targets, other.anchors, other.relations)

    @property
    def queries(self) -> tuple[str, ...]:
        """Q = targets ∪ anchors, in order, without repeats."""
        return tuple(dict.fromkeys((*self.targets, *self.anchors)))
