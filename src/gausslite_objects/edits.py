"""What people said of objects: deleted, renamed, merged, split, pinned, noted. An edit names a place: it outlives ids.

Edits are kept in the order in which they were made, each with its author and time. They win over detections, earlier
and later ones, until another edit undoes them.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.codec.json import object_as_json, object_from_json
from gausslite.codec.state_file import write_atomic
from gausslite.domain.checks import MAX_NAME_BYTES, quote_name, require_name
from gausslite.domain.errors import CodecError, InvalidInputError, MapFileError
from gausslite.domain.objects import ObjectLandmark, ObjectRole, TeamObject
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.mission.results import read_report

_FILE, CARRIED = "object_edits.json", "object_edits"
"""File of a run, and key of the report of a run that continues an edited map."""
_NONE: dict[str, list[Any]] = {"edits": []}
_OBJECTS = ("target", "other")
_MAX_EDITS = 1000
_AXES = ("x", "y", "z")
_LEAST_PART_M = 0.01
_PROBE = "?"
_APART_SHARE, _APART_M = 0.25, 0.05
"""Merged objects are at most this share of the longest side of both apart, or a cell of their boxes."""
_MARGIN_M = 0.1
"""An object is the edited one if its centre is in the edited one's box or within this of it."""


class EditKind(StrEnum):
    """What an edit does. UNDO: nothing more of the edit whose number it has."""

    DELETE = "delete"
    RENAME = "rename"
    MERGE = "merge"
    SPLIT = "split"
    PIN = "pin"
    NOTE = "note"
    UNDO = "undo"


@dataclass(frozen=True, slots=True)
class Edit:
    """One edit of an object as it was then. value: the new noun, the note, the number of the edit to undo, or where an
    object is split: an axis and a place, as "x=1.25"; empty for the middle of its longest side.

    other: the object that is merged into it. Raises InvalidInputError.
    """

    kind: EditKind
    author: str
    time_ns: int
    target: ObjectLandmark | None = None
    value: str = ""
    other: ObjectLandmark | None = None

    def __post_init__(self) -> None:
        require_name("edit author", self.author)
        if not self.author:
            raise InvalidInputError("edit author: expected the name of who edits, got an empty one")
        require_name(f"{self.kind} value", self.value)
        if self.kind in (EditKind.RENAME, EditKind.NOTE) and not self.value.strip():
            raise InvalidInputError(f"{self.kind}: expected a text, got an empty one")
        if self.kind is EditKind.SPLIT and self.target is not None and len(self.halves(self.target)) < 2:
            box = self.target.extent_m
            raise InvalidInputError(
                f"split {self.target.object_id}: expected a place inside its box {box.min_m} to {box.max_m}, "
                f"got {quote_name(self.value)}"
            )

    def concerned(self, landmarks: Sequence[ObjectLandmark]) -> list[ObjectLandmark]:
        """Return which objects are the edited one: that of its id, or all; in its place, of its noun."""
        assert self.target is not None
        found = [landmark for landmark in landmarks if _is_same(self.target, landmark)]
        return [landmark for landmark in found if landmark.object_id == self.target.object_id] or found

    @property
    def denied_noun(self) -> str:
        """What the edited object is called and is not; empty if its name stays."""
        is_denial = self.kind in (EditKind.DELETE, EditKind.RENAME)
        return self.target.noun if is_denial and self.target is not None else ""

    def halves(self, landmark: ObjectLandmark) -> list[ObjectLandmark]:
        """Return the parts of an object on both sides of the cut; the object if the cut does not go through it."""
        assert self.target is not None
        axis, at_m = _cut(self.value, self.target)
        low_m, high_m = list(landmark.extent_m.min_m), list(landmark.extent_m.max_m)
        if not low_m[axis] + _LEAST_PART_M <= at_m <= high_m[axis] - _LEAST_PART_M:
            return [landmark]
        parts = []
        for side_m, cut_m in ((low_m, [*high_m]), (high_m, [*low_m])):
            cut_m[axis] = at_m
            x, y, z = (0.5 * (at_m + side_m[i]) if i == axis else own for i, own in enumerate(landmark.centroid_m))
            box = AxisAlignedBox.around(np.array([side_m, cut_m]))
            parts.append(replace(landmark, centroid_m=(x, y, z), extent_m=box))
        return parts

    def as_json(self) -> dict[str, Any]:
        """Return the edit as JSON values."""
        target, other = (None if found is None else object_as_json(found) for found in (self.target, self.other))
        named = {"kind": str(self.kind), "author": self.author, "time_ns": self.time_ns, "value": self.value}
        return {**named, "target": target, "other": other}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Edit:
        """Return the edit of `as_json`. Raises CodecError."""
        try:
            target, other = (None if value[name] is None else object_from_json(value[name]) for name in _OBJECTS)
            author, time_ns, text = str(value["author"]), int(value["time_ns"]), str(value["value"])
            return cls(EditKind(value["kind"]), author, time_ns, target, text, other)
        except (KeyError, TypeError, ValueError, InvalidInputError) as error:
            raise CodecError(f"edit: expected the JSON of an edit, got other values ({error})") from error


@dataclass(frozen=True, slots=True)
class EditedObjects:
    """Objects after all edits; notes, pinned and parts by their ids. parts: the ids of which an object consists."""

    objects: tuple[ObjectLandmark, ...]
    notes: Mapping[str, tuple[str, ...]]
    pinned: frozenset[str]
    parts: Mapping[str, tuple[str, ...]]


def apply_edits(objects: Iterable[ObjectLandmark], edits: Sequence[Edit]) -> EditedObjects:
    """Return the objects that a person would see: each edit in its order, without those undone."""
    left, pinned = list(objects), set[str]()
    notes: dict[str, tuple[str, ...]] = {}
    parts: dict[str, tuple[str, ...]] = {landmark.object_id: (landmark.object_id,) for landmark in left}
    for edit in effective(edits):
        assert edit.target is not None
        found = edit.concerned(left)
        ids = {landmark.object_id for landmark in found}
        if edit.kind is EditKind.DELETE:
            left = [landmark for landmark in left if landmark.object_id not in ids]
        elif edit.kind is EditKind.RENAME:
            left = [replace(mark, noun=edit.value) if mark.object_id in ids else mark for mark in left]
        elif edit.kind is EditKind.MERGE and edit.other is not None:
            found += [mark for mark in left if mark.object_id not in ids and _is_same(edit.other, mark)]
            ids |= {landmark.object_id for landmark in found}
            rest = [landmark for landmark in left if landmark.object_id not in ids]
            left = [*rest, _merged(found)] if found else rest
            for landmark in found[:1]:
                parts[landmark.object_id] = tuple(own for mark in found for own in parts[mark.object_id])
        elif edit.kind is EditKind.SPLIT:
            # one of several, or each edit could double them
            for mark in found[:1]:
                first, *others = edit.halves(mark)
                others = [replace(half, object_id=_free_id(half, left, "-half")) for half in others]
                left = [half for own in left for half in ((first, *others) if own is mark else (own,))]
                parts |= {half.object_id: parts[mark.object_id] for half in others}
        elif edit.kind is EditKind.PIN:
            if not found:
                found = [replace(edit.target, confidence=1.0, object_id=_free_id(edit.target, left, "-pinned"))]
                left += found
                parts[found[0].object_id] = ()
            pinned |= {landmark.object_id for landmark in found}
        else:
            for landmark in found:
                notes[landmark.object_id] = (*notes.get(landmark.object_id, ()), f"{edit.author}: {edit.value}")
    return EditedObjects(tuple(left), notes, frozenset(pinned), parts)


def effective(edits: Sequence[Edit]) -> list[Edit]:
    """Return the edits that nobody has undone, in their order."""
    undone: set[int] = set()
    for number, edit in reversed(list(enumerate(edits, 1))):
        if edit.kind is EditKind.UNDO and number not in undone:
            undone.add(int(edit.value))
    return [edit for n, edit in enumerate(edits, 1) if edit.kind is not EditKind.UNDO and n not in undone]


def read_edits(folder: Path) -> tuple[Edit, ...]:
    """Return the edits of a run's folder, oldest first, or those of the map that it continues. Raises MapFileError."""
    path = folder / _FILE
    try:
        data = path.read_bytes() if path.exists() else json.dumps(read_report(folder).get(CARRIED, _NONE)).encode()
        return decode_edits(data)
    except (OSError, CodecError) as error:
        raise MapFileError(f"{path}: expected the edits of objects, got an unreadable file: {error}") from error


def write_edits(folder: Path, edits: Sequence[Edit]) -> None:
    """Replace the edits of a run's folder in one step. Raises StorageError."""
    write_atomic(folder / _FILE, encode_edits(edits))


def encode_edits(edits: Iterable[Edit]) -> bytes:
    """Return edits as a file."""
    return (json.dumps(edits_as_json(edits), indent=1) + "\n").encode()


def decode_edits(data: bytes) -> tuple[Edit, ...]:
    """Return the edits of `encode_edits`; none of an empty file. Raises CodecError."""
    try:
        content: Any = json.loads(data) if data else _NONE
        return tuple(map(Edit.from_json, content["edits"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CodecError(f"edits: expected the JSON of edits, got other bytes ({error})") from error


def require_room(edits: Sequence[Edit]) -> None:
    """Raise InvalidInputError if there are too many edits for another one."""
    if len(edits) >= _MAX_EDITS:
        raise InvalidInputError(f"edits: expected at most {_MAX_EDITS}, got more")


def require_near(target: ObjectLandmark, other: ObjectLandmark) -> None:
    """Raise InvalidInputError if two objects are too far apart to be one."""
    apart_m, longest_m = box_distance_m(target, other), max(*target.size_m, *other.size_m)
    reach_m = max(_APART_M, _APART_SHARE * longest_m)
    if apart_m > reach_m:
        raise InvalidInputError(
            f"merge {target.object_id}: expected an object within {reach_m:.2f} m of its box (a quarter of the "
            f"longest side of both), got {other.object_id}, {apart_m:.2f} m away"
        )


def box_distance_m(one: ObjectLandmark, other: ObjectLandmark) -> float:
    """Return the distance between the boxes of two objects; 0 if they touch."""
    first, second = one.extent_m, other.extent_m
    gaps_m = np.maximum(np.subtract(first.min_m, second.max_m), np.subtract(second.min_m, first.max_m))
    return float(np.linalg.norm(np.maximum(gaps_m, 0.0)))


def is_denied(edits: Sequence[Edit], noun: str, point_m: tuple[float, float, float]) -> bool:
    """Return True if people have deleted what a detector calls by a noun at a point, or have renamed it."""
    box, role = AxisAlignedBox(point_m, point_m), ObjectRole.OTHER
    probe = ObjectLandmark(_PROBE, noun, role, point_m, box, confidence=1.0, first_seen_ns=0, last_seen_ns=0)
    return not any(found.object_id == _PROBE and found.noun == noun for found in apply_edits([probe], edits).objects)


def edit_team(objects: Sequence[TeamObject], edits: Sequence[Edit]) -> tuple[tuple[TeamObject, ...], EditedObjects]:
    """Return a team's objects after all edits, with the observers of all their parts, and what people said of them."""
    observers = {found.landmark.object_id: found.observers for found in objects}
    edited = apply_edits([found.landmark for found in objects], edits)
    return tuple(
        TeamObject(landmark, tuple(seen for part in edited.parts[landmark.object_id] for seen in observers[part]))
        for landmark in edited.objects
    ), edited


def edits_as_json(edits: Iterable[Edit]) -> dict[str, Any]:
    """Return edits as JSON values, as a run's report carries them."""
    return {"edits": [edit.as_json() for edit in edits]}


def _is_same(known: ObjectLandmark, landmark: ObjectLandmark) -> bool:
    return known.noun == landmark.noun and known.distance_m(landmark.centroid_m) <= _MARGIN_M


def _cut(value: str, landmark: ObjectLandmark) -> tuple[int, float]:
    """Return the axis and the place of a cut. Raises InvalidInputError."""
    if not value:
        axis = int(np.argmax(landmark.size_m))
        return axis, 0.5 * (landmark.extent_m.min_m[axis] + landmark.extent_m.max_m[axis])
    name, _, place = value.partition("=")
    try:
        return _AXES.index(name), float(place)
    except ValueError:
        raise InvalidInputError(
            f"split: expected an axis and a place in metres, as x=1.25, got {quote_name(value)}"
        ) from None


def _merged(objects: Sequence[ObjectLandmark]) -> ObjectLandmark:
    """Return one object in the place of several; the first has its name."""
    corners_m = np.concatenate([landmark.corners_m for landmark in objects])
    x, y, z = np.mean([landmark.centroid_m for landmark in objects], axis=0).tolist()
    return replace(
        objects[0],
        centroid_m=(x, y, z),
        extent_m=AxisAlignedBox.around(corners_m),
        confidence=max(landmark.confidence for landmark in objects),
        first_seen_ns=min(landmark.first_seen_ns for landmark in objects),
        last_seen_ns=max(landmark.last_seen_ns for landmark in objects),
    )


def _free_id(landmark: ObjectLandmark, objects: Iterable[ObjectLandmark], suffix: str) -> str:
    taken, object_id = {other.object_id for other in objects}, landmark.object_id
    name = object_id.partition(suffix)[0].encode()[: MAX_NAME_BYTES - 16].decode(errors="ignore")
    numbers = itertools.count(2)
    free = itertools.chain((object_id, f"{name}{suffix}"), (f"{name}{suffix}{number}" for number in numbers))
    return next(name for name in free if name not in taken)
