"""The objects of a task in world coordinates, and what a detector searches for each noun."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.checks import quote_name, require_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import transform_points
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.domain.voxels import AxisAlignedBox

MAX_OBJECTS_PER_AGENT = 200
MAX_OBJECT_COORDINATE_M = 1e6
POINTING = "point at it (--set view=8099, or target-at=X,Y,Z,R without --task)"
_MAX_TIME_NS = 1 << 62
_CORNERS = np.array(list(np.ndindex(2, 2, 2)))


class MatchBasis(StrEnum):
    """Why a noun is searched as these classes. SIMILAR classes are different things; NONE: there is no class."""

    NAME = "name"
    SYNONYM = "synonym"
    KIND = "kind"
    TEXT_FEATURES = "text features"
    GENERIC = "generic noun"
    PHRASE = "any phrase"
    REGION = "ground truth"
    SIMILAR = "similar class"
    NONE = "no class"


@dataclass(frozen=True, slots=True)
class NounMatch:
    """The classes that a detector searches for one noun of a task.

    similarity: cosine of the noun's and the class's centred text features, None without a comparison. accepted: False
    if the class is a different thing and only reported; then `classes` has its name, and nothing is searched.
    """

    noun: str
    basis: MatchBasis  # how the classes were found
    classes: tuple[str, ...] = ()
    similarity: float | None = None
    accepted: bool = True
    known: tuple[str, ...] = ()  # the ground truth's regions, or the classes near to a noun without one
    min_score: float | None = None  # from which a detection counts
    is_there: Callable[[Float64[ndarray, "3"]], bool] | None = field(default=None, compare=False)  # where it can be

    @property
    def is_searched(self) -> bool:
        """Return True if the detector can find the noun."""
        return self.accepted and (bool(self.classes) or self.basis is MatchBasis.PHRASE)

    @property
    def warning(self) -> str | None:
        """Return why the noun cannot be found or may be a different thing; None if it is searched as itself."""
        if self.basis is MatchBasis.NONE:
            nearest = f" (near in meaning: {', '.join(map(repr, self.known))})" if self.known else ""
            return f"no class of the detector matches {self.noun!r}{nearest}; {POINTING}, or prompt a detector by text"
        if self.basis is MatchBasis.REGION and not self.classes:
            if not self.known:
                return f"nothing searches {self.noun!r}: there is no detector"
            return f"no region matches {self.noun!r}; the regions are {', '.join(self.known)}"
        if self.basis is not MatchBasis.SIMILAR:
            return None
        similar = f"the class most similar to {self.noun!r} is {self.classes[0]!r} (similarity {self.similarity:.2f})"
        if self.accepted:
            return f"{similar}: it counts as {self.noun!r}, because similar classes are accepted"
        return f"{similar}, a different thing: nothing is searched; accept-similar = true accepts it"

    def describe(self) -> str:
        """Return one line for the operator."""
        if self.warning is not None:
            return self.warning
        if self.basis is MatchBasis.GENERIC:
            return f"{self.noun!r} matches {len(self.classes)} classes of the detector ({self.basis})"
        if self.basis is MatchBasis.PHRASE:
            return f"{self.noun!r} is searched as a phrase"
        similarity = "" if self.similarity is None else f", similarity {self.similarity:.2f}"
        return f"{self.noun!r} is searched as {', '.join(map(repr, self.classes))} ({self.basis}{similarity})"


@dataclass(frozen=True, slots=True)
class NounReport:
    """A noun's match, and what has been detected of it so far."""

    match: NounMatch
    detections: int = 0  # their number in all frames
    best_score: float = 0.0  # the highest, in best_frame, below thresholds too; 0 and None without any
    objects: int = 0  # the number of reported ones
    rival: str | None = None  # the class that the detections rather show, or None
    best_frame: int | None = None  # number of the frame with the best score

    def describe(self) -> str:
        """Return one line for the operator: what was found, or why nothing was."""
        if not self.match.is_searched:
            return self.match.describe()
        return f"{self.match.describe()}: {self.outcome or self._unseen()}"

    @property
    def outcome(self) -> str:
        """What became of the detections; empty without any."""
        if not (self.detections or self.objects):
            return ""
        why = f"rather {self.rival!r}" if self.rival else "which takes two moments or places"
        confirmed = f"{self.objects} confirmed" if self.objects else f"none confirmed, {why}"
        return f"{self.detections} detections, best score {self.best_score:.2f}, {confirmed}"

    def _unseen(self) -> str:
        if self.best_frame is None:
            return f"not seen so far; if a frame shows it, {POINTING}"
        seen, least = f"seen in frame {self.best_frame} with {self.best_score:.2f}", self.match.min_score
        if least is None or self.best_score >= least:
            return f"{seen}, but too large, without depth, or enlarged only: a lower min-score may do, or {POINTING}"
        key = max(1, math.floor(80 * self.best_score)) / 100
        return f"{seen} (threshold {least:.2f}): --set min-score={key:g}, or {POINTING}"


def match_warnings(matches: Sequence[NounMatch]) -> tuple[str, ...]:
    """Return one message for each noun that cannot be found or may be a different thing."""
    return tuple(match.warning for match in matches if match.warning is not None)


class ObjectRole(StrEnum):
    """Role of an object in a task graph; OTHER: a target's noun, but not the place or colour that the task states."""

    TARGET = "target"
    ANCHOR = "anchor"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class ObjectLandmark:
    """One object of one agent or of a team; noun is a noun phrase of a task.

    first_seen_ns, last_seen_ns: capture times of the first and the latest frame that showed it. Raises
    InvalidInputError.
    """

    object_id: str  # unique in the report, stable while the object is known
    noun: str
    role: ObjectRole
    centroid_m: tuple[float, float, float]  # mean of its observed surface cells
    extent_m: AxisAlignedBox  # axis-aligned box of these cells
    confidence: float  # 0 to 1
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
    def corners_m(self) -> Float64[ndarray, "8 3"]:
        """Corners of the box."""
        return np.where(_CORNERS > 0, self.extent_m.max_m, self.extent_m.min_m)

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Side lengths of the box."""
        low, high = self.extent_m.min_m, self.extent_m.max_m
        return high[0] - low[0], high[1] - low[1], high[2] - low[2]

    def moved(self, T: Float64[ndarray, "4 4"]) -> ObjectLandmark:
        """Return the landmark after a rigid motion; its box contains the moved box. Raises InvalidInputError."""
        points_m = transform_points(T, np.vstack([self.corners_m, self.centroid_m]))
        x, y, z = points_m[-1].tolist()
        return replace(self, centroid_m=(x, y, z), extent_m=AxisAlignedBox.around(points_m[:-1]))

    def distance_m(self, point_m: Iterable[float]) -> float:
        """Return the distance of a point to the box; 0 inside."""
        low, high = self.extent_m.min_m, self.extent_m.max_m
        return math.hypot(*(max(a - p, 0.0, p - b) for a, p, b in zip(low, point_m, high, strict=True)))


@dataclass(frozen=True, slots=True)
class Answer:
    """The objects that a question means, and why there may be others. A count is their number."""

    objects: tuple[ObjectLandmark, ...]
    notes: tuple[str, ...] = ()  # why there may be other objects


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


@dataclass(frozen=True, slots=True)
class ObjectObserver:
    """One agent's observation of a team's object."""

    agent_id: str
    object_id: str
    target: int  # index of the noun in the agent's task, -1 for an anchor
    confidence: float
    first_seen_ns: int
    last_seen_ns: int


@dataclass(frozen=True, slots=True)
class TeamObject:
    """An object merged from the reports of the agents that observed it."""

    landmark: ObjectLandmark  # merged over the observers
    observers: tuple[ObjectObserver, ...]


def found_text(
    objects: Sequence[ObjectLandmark],
    targets: Sequence[str],
    region_means_m: Float32[ndarray, "n 3"],
    nouns: Sequence[NounReport] = (),
) -> str:
    """Return where the targets of a task are: "mug at (2.10, 1.95, 0.78) m, no book (2 detections, ...)".

    region_means_m: the region's Gaussians; an object without any was seen, but is not what the task means. nouns: say
    why what was detected is not reported.
    """
    elsewhere = ", none in the task's region"
    reasons = {n.match.noun: f" ({n.outcome}{elsewhere if n.objects else ''})" for n in nouns if n.outcome}
    meant = [
        found for found in objects if found.role is ObjectRole.TARGET and found.extent_m.contains(region_means_m).any()
    ]
    parts = []
    for noun in targets:
        centres_m = [found.centroid_m for found in meant if found.noun in (noun, noun_of(noun))]
        *others, last = ["({:.2f}, {:.2f}, {:.2f})".format(*centre_m) for centre_m in centres_m] or [""]
        places = f"{', '.join(others)} and {last} m" if others else last and f"{last} m"
        missing = f"no {noun}{reasons.get(noun, reasons.get(noun_of(noun), ''))}"
        parts.append(f"{noun} at {places}" if places else missing)
    return ", ".join(parts)
