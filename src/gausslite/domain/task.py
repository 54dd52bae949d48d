"""The operator's task as a graph of objects and spatial relations (Sec. III-B.1)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

_NUMBER_SUFFIX: Final = re.compile(r"_\d+$")


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


class TargetRole(StrEnum):
    """What the robot does with a target (docs/guides/task.md)."""

    OBJECT = "object"
    DESTINATION = "destination"
    TOOL = "tool"
    OBSTACLE = "obstacle"


class Superlative(StrEnum):
    """Attributes that compare all objects of a noun. nearest and farthest are relative to the camera."""

    LARGEST = "largest"
    SMALLEST = "smallest"
    TALLEST = "tallest"
    SHORTEST = "shortest"
    LONGEST = "longest"
    WIDEST = "widest"
    NARROWEST = "narrowest"
    THICKEST = "thickest"
    THINNEST = "thinnest"
    HIGHEST = "highest"
    LOWEST = "lowest"
    LEFTMOST = "leftmost"
    RIGHTMOST = "rightmost"
    NEAREST = "nearest"
    FARTHEST = "farthest"


@dataclass(frozen=True, slots=True)
class Relation:
    """`predicate(target, anchor)`; both are names of the graph.

    negated: the relation does not hold. min_m, max_m: bounds of the distance to the anchor; equal bounds mean "about".
    """

    predicate: Predicate
    target: str
    anchor: str
    negated: bool = False
    min_m: float | None = None
    max_m: float | None = None

    def __str__(self) -> str:
        """Return a form for people, such as "not on(mug, table)"."""
        bounds = "".join(
            f" {sign} {value:g} m" for sign, value in ((">=", self.min_m), ("<=", self.max_m)) if value is not None
        )
        return f"{'not ' if self.negated else ''}{self.predicate}({self.target}, {self.anchor}){bounds}"


@dataclass(frozen=True, slots=True)
class ObjectAttributes:
    """Colour and superlative of one named object of a graph; at least one is not None."""

    name: str
    colour: str | None = None
    superlative: Superlative | None = None


@dataclass(frozen=True, slots=True)
class TaskGraph:
    """Targets to map in detail with their roles, anchors that locate them, and relations r(target, anchor).

    Targets, anchors and excluded objects are names: a noun, with the suffix _2, _3, ... for a further object of that
    noun with other attributes. roles has one role per target; an empty tuple means that every target is an object.
    excluded: objects to leave out. context: rooms and places, which locate nothing. See docs/guides/task.md.
    """

    task_id: str
    text: str
    targets: tuple[str, ...]
    anchors: tuple[str, ...]
    relations: tuple[Relation, ...]
    warnings: tuple[str, ...] = ()
    roles: tuple[TargetRole, ...] = ()
    attributes: tuple[ObjectAttributes, ...] = ()
    excluded: tuple[str, ...] = ()
    context: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.roles:
            object.__setattr__(self, "roles", (TargetRole.OBJECT,) * len(self.targets))

    def is_equivalent_to(self, other: TaskGraph) -> bool:
        """Return True if everything but the id, the text, the warnings and the context is equal."""
        return self._meaning == other._meaning

    @property
    def _meaning(self) -> tuple[object, ...]:
        return self.targets, self.anchors, self.relations, self.roles, self.attributes, self.excluded

    @property
    def queries(self) -> tuple[str, ...]:
        """The nouns to detect, in order, without duplicates: Q of Sec. III-B.1, and the excluded nouns."""
        nouns = dict.fromkeys(noun_of(name) for name in (*self.targets, *self.anchors))
        return tuple(dict.fromkeys((*nouns, *self.excluded_nouns)))

    @property
    def excluded_nouns(self) -> tuple[str, ...]:
        """The nouns of excluded objects that no target has: their pixels belong to no target."""
        targets = {noun_of(name) for name in self.targets}
        return tuple(dict.fromkeys(noun for noun in map(noun_of, self.excluded) if noun not in targets))


def noun_of(name: str) -> str:
    """Return the noun of an object's name: "block_2" is a "block"."""
    return _NUMBER_SUFFIX.sub("", name)
