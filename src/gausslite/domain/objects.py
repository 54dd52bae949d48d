"""The objects of a task in world coordinates: what one agent reports, and what a team has merged from its reports."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import quote_name, require_name
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.domain.voxels import AxisAlignedBox

MAX_OBJECTS_PER_AGENT = 200
NO_TARGET_INDEX = -1
MAX_OBJECT_COORDINATE_M = 1e6
_MAX_TIME_NS = 1 << 62


class ObjectRole(StrEnum):
    """Role of an object in a task graph."""

    TARGET = "target"
    ANCHOR = "anchor"


@dataclass(frozen=True, slots=True)
class ObjectLandmark:
    """One object of one agent or of a team; noun is a noun phrase of a task.

    centroid_m: mean of its observed surface cells; extent_m: their axis-aligned box. confidence: 0 to 1. first_seen_ns,
    last_seen_ns: capture times of the first and the latest frame that showed it. Raises InvalidInputError.
    """

    object_id: str
    noun: str
    role: ObjectRole
    centroid_m: tuple[float, float, float]
    extent_m: AxisAlignedBox
    confidence: float
    first_seen_ns: int
    last_seen_ns: int

    def __post_init__(self) -> None:
        for name, text in (("id", self.object_id), ("noun", self.noun)):
            require_name(f"object {name}", text)
            if not text:
                raise InvalidInputError(f"object {name}: expected a text, got an empty one")
        numbers = (*self.centroid_m, *self.extent_m.min_m, *self.extent_m.max_m)
        if not all(abs(value) <= MAX_OBJECT_COORDINATE_M for value in numbers):
            raise InvalidInputError(
                f"object {quote_name(self.object_id)}: expected coordinates within "
                f"±{MAX_OBJECT_COORDINATE_M:g} m, got others"
            )
        if not 0.0 <= self.confidence <= 1.0:
            raise InvalidInputError(f"object confidence: expected 0 to 1, got {self.confidence}")
        if not -_MAX_TIME_NS <= self.first_seen_ns <= self.last_seen_ns <= _MAX_TIME_NS:
            raise InvalidInputError(
                f"object times: expected first_seen_ns <= last_seen_ns, got {self.first_seen_ns}, {self.last_seen_ns}"
            )

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Side lengths of the box."""
        low, high = self.extent_m.min_m, self.extent_m.max_m
        return high[0] - low[0], high[1] - low[1], high[2] - low[2]

    def distance_m(self, point_m: Iterable[float]) -> float:
        """Return the distance of a point to the box; 0 inside."""
        low, high = self.extent_m.min_m, self.extent_m.max_m
        return math.hypot(*(max(a - p, 0.0, p - b) for a, p, b in zip(low, point_m, high, strict=True)))


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """The task graph of one agent and its object landmarks; a later report replaces an earlier one."""

    graph: TaskGraph
    objects: tuple[ObjectLandmark, ...] = ()

    def __post_init__(self) -> None:
        if len(self.objects) > MAX_OBJECTS_PER_AGENT:
            raise InvalidInputError(f"objects: expected at most {MAX_OBJECTS_PER_AGENT}, got {len(self.objects)}")
        if len({landmark.object_id for landmark in self.objects}) != len(self.objects):
            raise InvalidInputError("objects: expected different ids, got a repeated one")

    def target_index(self, noun: str) -> int:
        """Return the index of a noun among the task's targets, as in a Gaussian's `target`; -1 for other nouns."""
        nouns = [noun_of(target) for target in self.graph.targets]
        return nouns.index(noun) if noun in nouns else NO_TARGET_INDEX


@dataclass(frozen=True, slots=True)
class ObjectObserver:
    """One agent's observation of a team's object; target: index of the noun in the agent's task, -1 for an anchor."""

    agent_id: str
    object_id: str
    target: int
    confidence: float
    first_seen_ns: int
    last_seen_ns: int


@dataclass(frozen=True, slots=True)
class TeamObject:
    """An object merged from the reports of the agents that observed it."""

    landmark: ObjectLandmark
    observers: tuple[ObjectObserver, ...]


def object_of_gaussian(
    objects: Iterable[TeamObject], agent_id: str, target: int, mean_m: Iterable[float]
) -> TeamObject | None:
    """Return the object that a fused Gaussian shows: the nearest with this target of the agent that sent the Gaussian.

    agent_id: the agent that won the Gaussian's voxel; target: the Gaussian's target index. None without such an object.
    """
    if target == NO_TARGET_INDEX:
        return None
    point = tuple(mean_m)
    seen_as = (agent_id, target)
    matching = [found for found in objects if seen_as in ((seen.agent_id, seen.target) for seen in found.observers)]
    return min(matching, key=lambda found: found.landmark.distance_m(point), default=None)
