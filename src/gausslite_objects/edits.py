"""What people said of objects: deleted, renamed, merged, pinned or noted. An edit names a place, so it outlives ids.

Edits are kept in the order in which they were made, each with its author and time. They win over detections, earlier
and later ones, until another edit undoes them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from gausslite.codec.json import object_as_json, object_from_json
from gausslite.codec.state_file import write_atomic
from gausslite.domain.checks import quote_name, require_name
from gausslite.domain.errors import CodecError, InvalidInputError, MapFileError
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.mission.results import read_report

_FILE, CARRIED = "object_edits.json", "object_edits"
"""File of a run, and key of the report of a run that continues an edited map."""
_NONE: dict[str, list[Any]] = {"edits": []}
_OBJECTS = ("target", "other")
_MAX_EDITS = 1000
_MARGIN_M = 0.1
"""An object is the edited one if its centre is in the edited one's box or within this of it."""


class EditKind(StrEnum):
    """What an edit does. UNDO: nothing more of the edit whose number it has."""

    DELETE = "delete"
    RENAME = "rename"
    MERGE = "merge"
    PIN = "pin"
    NOTE = "note"
    UNDO = "undo"


@dataclass(frozen=True, slots=True)
class Edit:
    """One edit of an object as it was then. value: the new noun, the note, or the number of the edit to undo.

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
        if self.kind in (EditKind.RENAME, EditKind.NOTE):
            require_name(f"{self.kind} value", self.value)
            if not self.value.strip():
                raise InvalidInputError(f"{self.kind}: expected a text, got an empty one")

    def concerns(self, landmark: ObjectLandmark) -> bool:
        """Return True if an object is the edited one: the same noun, in its place."""
        return self.target is not None and _is_same(self.target, landmark)

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
    """Objects after all edits; notes and pinned by their ids."""

    objects: tuple[ObjectLandmark, ...]
    notes: Mapping[str, tuple[str, ...]]
    pinned: frozenset[str]


def apply_edits(objects: Iterable[ObjectLandmark], edits: Sequence[Edit]) -> EditedObjects:
    """Return the objects that a person would see: each edit in its order, without those undone."""
    left, pinned = list(objects), set[str]()
    notes: dict[str, tuple[str, ...]] = {}
    for edit in effective(edits):
        assert edit.target is not None
        found = [landmark for landmark in left if edit.concerns(landmark)]
        if edit.kind is EditKind.DELETE:
            left = [landmark for landmark in left if landmark not in found]
        elif edit.kind is EditKind.RENAME:
            left = [replace(mark, noun=edit.value) if mark in found else mark for mark in left]
        elif edit.kind is EditKind.MERGE and edit.other is not None:
            found += [mark for mark in left if mark not in found and _is_same(edit.other, mark)]
            rest = [landmark for landmark in left if landmark not in found]
            left = [*rest, _merged(found)] if found else rest
        elif edit.kind is EditKind.PIN:
            if not found:
                found = [replace(edit.target, confidence=1.0, object_id=_free_id(edit.target, left))]
                left += found
            pinned |= {landmark.object_id for landmark in found}
        else:
            for landmark in found:
                notes[landmark.object_id] = (*notes.get(landmark.object_id, ()), f"{edit.author}: {edit.value}")
    return EditedObjects(tuple(left), notes, frozenset(pinned))


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
        content: Any = json.loads(path.read_bytes()) if path.exists() else read_report(folder).get(CARRIED, _NONE)
        return tuple(map(Edit.from_json, content["edits"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, CodecError) as error:
        raise MapFileError(f"{path}: expected the edits of objects, got an unreadable file: {error}") from error


def add_edit(folder: Path, edit: Edit) -> int:
    """Append an edit to a run's folder, durably, and return its number. Raises InvalidInputError, StorageError."""
    edits = read_edits(folder)
    if len(edits) >= _MAX_EDITS:
        raise InvalidInputError(f"{folder}: expected at most {_MAX_EDITS} edits, got more")
    if edit.kind is EditKind.UNDO and not (edit.value.isdecimal() and 1 <= int(edit.value) <= len(edits)):
        raise InvalidInputError(
            f"undo: expected the number of an edit, 1 to {len(edits)}, got {quote_name(edit.value)}"
        )
    write_edits(folder, (*edits, edit))
    return len(edits) + 1


def write_edits(folder: Path, edits: Sequence[Edit]) -> None:
    """Replace the edits of a run's folder in one step. Raises StorageError."""
    write_atomic(folder / _FILE, (json.dumps(edits_as_json(edits), indent=1) + "\n").encode())


def edits_as_json(edits: Iterable[Edit]) -> dict[str, Any]:
    """Return edits as JSON values, as a run's report carries them."""
    return {"edits": [edit.as_json() for edit in edits]}


def _is_same(known: ObjectLandmark, landmark: ObjectLandmark) -> bool:
    return known.noun == landmark.noun and known.distance_m(landmark.centroid_m) <= _MARGIN_M


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


def _free_id(landmark: ObjectLandmark, objects: Iterable[ObjectLandmark]) -> str:
    taken, object_id = {other.object_id for other in objects}, landmark.object_id
    while object_id in taken:
        object_id += "-pinned"
    return object_id
