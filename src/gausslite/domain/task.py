"""The operator's task as a graph of objects and spatial relations (Sec. III-B.1)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Protocol, runtime_checkable

from gausslite.domain.errors import TaskError

_NUMBER_SUFFIX: Final = re.compile(r"_\d+$")
EXAMPLE = "'Pick up the mug on the table'"


class Predicate(StrEnum):
    """Predicates of the relation filter, the first two of the paper. between(t, a) and (t, b) form one relation."""

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
    """What the robot does with a target (docs/guides/task.md); POINTED: a person points at it, nothing searches it."""

    OBJECT = "object"
    DESTINATION = "destination"
    TOOL = "tool"
    OBSTACLE = "obstacle"
    POINTED = "pointed"


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

    min_m, max_m: bounds of the distance to the anchor; equal bounds mean "about".
    """

    predicate: Predicate
    target: str
    anchor: str
    negated: bool = False  # the relation does not hold
    min_m: float | None = None
    max_m: float | None = None

    @property
    def is_bounded(self) -> bool:
        """True if the distance to the anchor is limited."""
        return self.min_m is not None or self.max_m is not None

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
    """

    task_id: str
    text: str  # the sentence
    targets: tuple[str, ...]
    anchors: tuple[str, ...]
    relations: tuple[Relation, ...]
    warnings: tuple[str, ...] = ()  # what the parser did not understand, for the operator
    roles: tuple[TargetRole, ...] = ()
    attributes: tuple[ObjectAttributes, ...] = ()
    excluded: tuple[str, ...] = ()  # objects to leave out
    context: tuple[str, ...] = ()  # rooms and places, which locate nothing. See docs/guides/task.md

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
        pointed = self.pointed
        searched = [target for target in self.targets if target not in pointed]
        nouns = dict.fromkeys(noun_of(name) for name in (*searched, *self.anchors))
        return tuple(dict.fromkeys((*nouns, *self.excluded_nouns)))

    @property
    def pointed(self) -> tuple[str, ...]:
        """The targets that a person points at, which no detector searches."""
        roles = zip(self.targets, self.roles, strict=True)
        return tuple(target for target, role in roles if role is TargetRole.POINTED)

    def with_pointed(self, nouns: Iterable[str]) -> TaskGraph:
        """Return the graph with the nouns that a person points at among its targets. Raises TaskError."""
        known = set(map(noun_of, self.targets))
        new = tuple(dict.fromkeys(noun for noun in nouns if noun not in known))
        roles = (*self.roles, *(TargetRole.POINTED for _ in new))
        graph = replace(self, targets=(*self.targets, *new), roles=roles)
        require_graph(graph)
        return graph

    def with_warnings(self, more: Iterable[str]) -> TaskGraph:
        """Return the graph with more warnings, as many as the limits allow."""
        return replace(self, warnings=(*self.warnings, *more)[: LIMITS.max_warnings])

    @property
    def excluded_nouns(self) -> tuple[str, ...]:
        """The nouns of excluded objects that no target has: their pixels belong to no target."""
        targets = {noun_of(name) for name in self.targets}
        return tuple(dict.fromkeys(noun for noun in map(noun_of, self.excluded) if noun not in targets))


@runtime_checkable
class TaskParser(Protocol):
    """Parse a task given as a sentence."""

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError if the text is empty, too long or names no object."""


def noun_of(name: str) -> str:
    """Return the noun of an object's name: "block_2" is a "block"."""
    return _NUMBER_SUFFIX.sub("", name)


@dataclass(frozen=True, slots=True)
class TaskLimits:
    """Largest sizes of a task and its graph."""

    max_text_chars: int = 1000
    max_targets: int = 16
    max_anchors: int = 16
    max_phrase_chars: int = 64
    max_relations: int = 64
    max_warnings: int = 64
    max_distance_m: float = 10_000.0


LIMITS = TaskLimits()


def require_task_text(text: str, limits: TaskLimits = LIMITS) -> None:
    """Raise TaskError unless the text is UTF-8, contains a letter and is short enough."""
    if len(text) > limits.max_text_chars:
        raise TaskError(f"task text: expected at most {limits.max_text_chars} characters, got {len(text)}")
    # surrogates: Python's form of bytes that are not UTF-8, which neither messages nor files can store
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise TaskError(f"task text: expected UTF-8, got bytes of another encoding in {text.strip()!r}")
    if not any(character.isalpha() for character in text):
        raise TaskError(f"task text: expected a sentence that names an object, such as {EXAMPLE}, got {text.strip()!r}")


def require_graph(graph: TaskGraph, limits: TaskLimits = LIMITS) -> None:
    """Raise TaskError unless the graph, which may lack a text, is within the limits and relates listed nouns."""
    if graph.text:
        require_task_text(graph.text, limits)
    if not graph.targets:
        raise TaskError(f"task targets: expected at least one object, such as in {EXAMPLE}, got none")
    if len(graph.roles) != len(graph.targets):
        raise TaskError(f"task roles: expected one for each of {len(graph.targets)} targets, got {len(graph.roles)}")
    for role, names, max_count in (
        ("targets", graph.targets, limits.max_targets),
        ("anchors", graph.anchors, limits.max_anchors),
        ("excluded", graph.excluded, limits.max_targets),
        ("context", graph.context, limits.max_anchors),
    ):
        _require_phrases(role, names, max_count, limits.max_phrase_chars)
    both = set(graph.excluded) & {*graph.targets, *graph.anchors}
    if both:
        raise TaskError(
            f"task excluded: expected other objects than targets and anchors, got {', '.join(sorted(both))}"
        )
    if len(graph.relations) > limits.max_relations or len(graph.warnings) > limits.max_warnings:
        expected = f"{limits.max_relations} relations and {limits.max_warnings} warnings"
        raise TaskError(f"task: expected at most {expected}, got {len(graph.relations)} and {len(graph.warnings)}")
    for relation in graph.relations:
        _require_relation(relation, graph, limits)
    _require_attributes(graph, limits)


def _require_relation(relation: Relation, graph: TaskGraph, limits: TaskLimits) -> None:
    if relation.target not in graph.targets:
        raise TaskError(f"task {relation.predicate}: expected one of the targets first, got {relation.target!r}")
    if relation.anchor not in graph.anchors:
        raise TaskError(f"task {relation.predicate}: expected one of the anchors last, got {relation.anchor!r}")
    low_m, high_m = relation.min_m or 0.0, limits.max_distance_m if relation.max_m is None else relation.max_m
    if not 0.0 <= low_m <= high_m <= limits.max_distance_m:
        expected = f"0 <= min_m <= max_m <= {limits.max_distance_m:g}"
        raise TaskError(f"task {relation.predicate}: expected {expected}, got {relation.min_m} and {relation.max_m}")


def _require_attributes(graph: TaskGraph, limits: TaskLimits) -> None:
    known = {*graph.targets, *graph.anchors, *graph.excluded}
    names = tuple(attribute.name for attribute in graph.attributes)
    if len(set(names)) != len(names) or not known.issuperset(names):
        raise TaskError(f"task attributes: expected each object of the graph at most once, got {', '.join(names)}")
    _require_phrases(
        "colours",
        tuple(dict.fromkeys(attribute.colour for attribute in graph.attributes if attribute.colour is not None)),
        len(names),
        limits.max_phrase_chars,
    )


def _require_phrases(role: str, phrases: tuple[str, ...], max_count: int, max_chars: int) -> None:
    if len(phrases) > max_count:
        raise TaskError(f"task {role}: expected at most {max_count} objects, got {len(phrases)}")
    if len(set(phrases)) != len(phrases):
        raise TaskError(f"task {role}: expected each object once, got {', '.join(phrases)}")
    for phrase in phrases:
        if not phrase.strip() or phrase != phrase.strip() or not phrase.isprintable():
            raise TaskError(f"task {role}: expected printable phrases without outer spaces, got {phrase!r}")
        if len(phrase) > max_chars:
            raise TaskError(f"task {role}: expected phrases of at most {max_chars} characters, got {len(phrase)}")
