"""Named areas of a place, such as its kitchen: polygons on a floor, in a file beside the map; questions name them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.checks import quote_name, require_name
from gausslite.domain.errors import CodecError, InvalidInputError, MapFileError
from gausslite.domain.objects import MAX_OBJECT_COORDINATE_M
from gausslite.domain.pose import UpAxis, transform_points, unit_up_axis
from gausslite.domain.task import Predicate, TargetRole, TaskGraph, noun_of
from gausslite.mission.results import read_report

_FILE, CARRIED_AREAS = "areas.json", "areas"
"""File of a run, and key of the report of a run that continues its map."""
_MAX_AREAS, _MAX_CORNERS = 200, 200
_STOREY_M = (-0.3, 2.7)
"""Heights above the floor that belong to an area; another storey does not."""
_SETTLED_M = 0.02
_BEFORE: Final = r"(?:^|\b(?:in|inside|at|within|from|(?P<out>not (?:in|inside|at)|outside(?: of)?|out of))\s+)"
_AFTER: Final = r"(?=\s*(?:$|[?.,!]|(?:on|near|and|or|that|which|with|is|are|there|by|next|under|beside|behind|in)\b))"
"""Around the name of an area: the kitchen table is no place in the kitchen."""
_EVERYTHING: Final = {"", "what is", "what's", "what is there", "what", "list", "show", "everything", "all", "objects"}

_IN: Final = (Predicate.INSIDE, Predicate.ON)

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon on a floor, in the map's frame; the corners follow each other around it. Raises InvalidInputError."""

    name: str
    corners_m: tuple[Point, ...]

    def __post_init__(self) -> None:
        require_name("area name", self.name)
        if not self.name.strip():
            raise InvalidInputError("area name: expected a text such as 'kitchen', got an empty one")
        count = len(self.corners_m)
        if not 3 <= count <= _MAX_CORNERS:
            raise InvalidInputError(f"area {self.name}: expected 3 to {_MAX_CORNERS} corners, got {count}")
        if not all(abs(value) <= MAX_OBJECT_COORDINATE_M for corner in self.corners_m for value in corner):
            raise InvalidInputError(
                f"area {self.name}: expected corners within ±{MAX_OBJECT_COORDINATE_M:g} m, got others"
            )

    def contains(self, point_m: Point, up_axis: UpAxis) -> bool:
        """Return True for a point above the polygon, up to the height of a storey."""
        return self.distance_m(point_m, up_axis) == 0.0

    def distance_m(self, point_m: Point, up_axis: UpAxis) -> float:
        """Return how far a point is from above the polygon, 0 there; infinite on another storey."""
        up = np.array(unit_up_axis(up_axis))
        corners_m, point = np.array(self.corners_m), np.array(point_m)
        height_m = float((point - corners_m.mean(axis=0)) @ up)
        if not _STOREY_M[0] <= height_m <= _STOREY_M[1]:
            return np.inf
        plane = _horizontal_axes(up)
        # relative to the point: float32 has no room for large coordinates
        outline = np.ascontiguousarray((corners_m - point) @ plane, np.float32)
        return max(0.0, -cv2.pointPolygonTest(outline, (0.0, 0.0), True))

    def moved(self, motion: Float64[ndarray, "4 4"]) -> Area:
        """Return the area in another frame. Raises InvalidInputError if it is too far from its origin."""
        corners_m = transform_points(motion, np.array(self.corners_m)).tolist()
        return Area(self.name, tuple((x, y, z) for x, y, z in corners_m))

    def as_json(self) -> dict[str, Any]:
        """Return the area as JSON values."""
        return {"name": self.name, "corners_m": [list(corner) for corner in self.corners_m]}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Area:
        """Return the area of `as_json`. Raises CodecError."""
        try:
            corners_m = tuple((float(x), float(y), float(z)) for x, y, z in value["corners_m"])
            return cls(str(value["name"]), corners_m)
        except (KeyError, TypeError, ValueError, InvalidInputError) as error:
            raise CodecError(f"area: expected a name and corners_m of three numbers, got others ({error})") from error


def with_area(areas: Iterable[Area], area: Area) -> tuple[Area, ...]:
    """Return the areas with this one in the place of one of its name. Raises InvalidInputError for too many."""
    others = [other for other in areas if not _is_named(other, area.name)]
    if len(others) >= _MAX_AREAS:
        raise InvalidInputError(f"areas: expected at most {_MAX_AREAS}, got more")
    return (*others, area)


def settled(areas: Iterable[Area], known: Sequence[Area]) -> tuple[Area, ...]:
    """Return the areas; for one that has hardly moved the known one, as a robot's frame is fitted again and again."""
    return tuple(next((own for own in known if _is_close(own, area)), area) for area in areas)


def _is_close(one: Area, other: Area) -> bool:
    if (one.name, len(one.corners_m)) != (other.name, len(other.corners_m)):
        return False
    return np.allclose(one.corners_m, other.corners_m, rtol=0.0, atol=_SETTLED_M)


def joined(own: Sequence[Area], others: Iterable[Area]) -> tuple[Area, ...]:
    """Return own areas, and the others whose names are none of them."""
    return (*own, *(area for area in others if not any(_is_named(area, known.name) for known in own)))


def without_area(areas: Sequence[Area], name: str) -> tuple[Area, ...]:
    """Return the areas without the one of a name. Raises InvalidInputError if there is none."""
    kept = tuple(area for area in areas if not _is_named(area, name))
    if len(kept) == len(areas):
        known = ", ".join(area.name for area in areas) or "none"
        raise InvalidInputError(f"area: expected one of {known}, got {quote_name(name)}")
    return kept


def read_areas(folder: Path) -> tuple[Area, ...]:
    """Return the areas of a run's folder, or those of the map that it continues. Raises MapFileError."""
    path = folder / _FILE
    try:
        carried = read_report(folder).get(CARRIED_AREAS, [])
        return decode_areas(path.read_bytes() if path.exists() else json.dumps({"areas": carried}).encode())
    except (OSError, CodecError) as error:
        raise MapFileError(f"{path}: expected named areas, got an unreadable file: {error}") from error


def write_areas(folder: Path, areas: Iterable[Area]) -> None:
    """Replace the areas of a run's folder in one step. Raises StorageError."""
    write_atomic(folder / _FILE, encode_areas(areas))


def encode_areas(areas: Iterable[Area]) -> bytes:
    """Return areas as a file."""
    return (json.dumps({"areas": [area.as_json() for area in areas]}, indent=1) + "\n").encode()


def decode_areas(data: bytes) -> tuple[Area, ...]:
    """Return the areas of `encode_areas`; none of an empty file. Raises CodecError."""
    try:
        content: Any = json.loads(data) if data else {"areas": []}
        return tuple(map(Area.from_json, content["areas"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CodecError(f"areas: expected the JSON of areas, got other bytes ({error})") from error


@dataclass(frozen=True, slots=True)
class NamedPlaces:
    """The areas that a question names: what it means is in all of `inside`, and in none of `outside`.

    question: the rest, empty if it asks for everything there.
    """

    question: str
    inside: tuple[Area, ...] = ()
    outside: tuple[Area, ...] = ()

    @classmethod
    def of(cls, question: str, areas: Sequence[Area]) -> NamedPlaces:
        """Find the names in a question such as "chairs in the kitchen", the longest names first."""
        inside, outside = list[Area](), list[Area]()
        for area in sorted(areas, key=lambda other: -len(other.name)):
            name = rf"{_BEFORE}(?:the |my |our )?{re.escape(area.name.strip())}{_AFTER}"
            named = re.search(name, question, re.IGNORECASE)
            if named is not None:
                (outside if named["out"] else inside).append(area)
                question = f"{question[: named.start()]} {question[named.end() :]}"
        rest = " ".join(question.split()).rstrip("?., ")
        return cls(
            "" if rest.casefold() in _EVERYTHING and (inside or outside) else rest, tuple(inside), tuple(outside)
        )

    def contain(self, point_m: Point, up_axis: UpAxis) -> bool:
        """Return True for a point in these places."""
        return self._distance_m(point_m, up_axis) == 0.0

    def left_out_note(self, found: Sequence[Point], up_axis: UpAxis) -> str:
        """Return a line about objects that a question means, of which none is in these places."""
        places = [f"in {area.name!r}" for area in self.inside] + [f"outside {area.name!r}" for area in self.outside]
        nearest_m = min(self._distance_m(point_m, up_axis) for point_m in found)
        nearest = f": the nearest is {nearest_m:.1f} m away" if 0.0 < nearest_m < np.inf else ""
        return f"{len(found)} seen, none {' and '.join(places)}{nearest}"

    def _distance_m(self, point_m: Point, up_axis: UpAxis) -> float:
        """Return how far a point is from the farthest of these places; infinite in an area that is left out."""
        is_left_out = any(area.contains(point_m, up_axis) for area in self.outside)
        return max([np.inf if is_left_out else 0.0, *(area.distance_m(point_m, up_axis) for area in self.inside)])


@dataclass(frozen=True, slots=True)
class TaskPlaces:
    """Where the objects of a task are: in one of the areas that it names, and in none that it leaves out.

    by_noun: of a target. anchors: those that are areas, in lower case. notes: on places that are none.
    """

    by_noun: Mapping[str, NamedPlaces]
    anchors: frozenset[str]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, graph: TaskGraph, areas: Sequence[Area]) -> TaskPlaces:
        """Find the areas among the anchors of a task, in its sentence and in its context."""
        said = NamedPlaces.of(graph.text, areas)
        context = {place.casefold() for place in graph.context}
        objects = [name for name, role in zip(graph.targets, graph.roles, strict=True) if role is TargetRole.OBJECT]
        by_noun = dict.fromkeys(map(noun_of, graph.targets), NamedPlaces(""))
        anchors, used = set(), set[str]()
        for area in areas:
            name = area.name.strip().casefold()
            related = [own for own in graph.relations if own.anchor.casefold() == name and own.predicate in _IN]
            negated = {own.target: own.negated for own in related}
            anchors |= {name} if related else set()
            if not related and (area in (*said.inside, *said.outside) or name in context):
                negated = dict.fromkeys(objects, area in said.outside)
            used |= {name} if negated else set()
            for target, is_outside in negated.items():
                known, more = by_noun[noun_of(target)], ((), (area,)) if is_outside else ((area,), ())
                by_noun[noun_of(target)] = NamedPlaces("", known.inside + more[0], known.outside + more[1])
        unknown = [place for place in graph.context if not any(place.casefold() in name for name in used)]
        return cls(by_noun, frozenset(anchors), tuple(describe_unknown(place, areas) for place in unknown))

    def contain(self, noun: str, point_m: Point, up_axis: UpAxis) -> bool:
        """Return True for a point where objects of the noun are meant."""
        named = self.by_noun.get(noun)
        if named is None:
            return True
        is_inside = not named.inside or any(area.contains(point_m, up_axis) for area in named.inside)
        return is_inside and not any(area.contains(point_m, up_axis) for area in named.outside)


def describe_unknown(place: str, areas: Iterable[Area]) -> str:
    """Return one line on a place that a sentence names and that is no area."""
    known = ", ".join(repr(area.name) for area in areas)
    return f"{place!r} is no named area; {f'areas are {known}' if known else 'there are no areas yet'}"


def _is_named(area: Area, name: str) -> bool:
    return area.name.strip().casefold() == name.strip().casefold()


def _horizontal_axes(up: Float64[ndarray, "3"]) -> Float64[ndarray, "3 2"]:
    """Return two axes of the floor's plane, as columns."""
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)], axis=1)
