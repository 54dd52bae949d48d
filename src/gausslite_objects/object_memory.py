"""Correct the objects of a place and name its areas: the protocol, and a run's folder."""

from __future__ import annotations

import getpass
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gausslite.codec.json import object_from_json
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import ObjectLandmark
from gausslite.mission.results import read_report
from gausslite_objects.areas import Area, read_areas, with_area, without_area, write_areas
from gausslite_objects.edits import Edit, EditKind, apply_edits, read_edits, require_near, require_room, write_edits

_NEEDS_VALUE = (EditKind.RENAME, EditKind.MERGE, EditKind.NOTE)
_MAX_DIGITS = 10


@dataclass(frozen=True, slots=True)
class EditEntry:
    """An edit as a person made it. number: from 1, in the order of edits. object_id: empty for UNDO."""

    number: int
    kind: EditKind
    object_id: str
    value: str
    author: str
    time_ns: int

    @classmethod
    def of(cls, number: int, edit: Edit) -> EditEntry:
        """Return the entry of an edit."""
        object_id = "" if edit.target is None else edit.target.object_id
        return cls(number, edit.kind, object_id, edit.value, edit.author, edit.time_ns)

    def describe(self) -> str:
        """Return one line for a person."""
        what = f'"{self.object_id}"' if self.object_id else self.value
        to = f" as {quote_name(self.value)}" if self.object_id and self.value else ""
        return f"{self.number}: {self.kind} {what}{to}, by {self.author}"


class ObjectMemory(Protocol):
    """What people say of a place. Edits win over detections until they are undone; all methods raise GaussLiteError."""

    def edits(self) -> list[EditEntry]:
        """Return all edits, oldest first."""
        ...

    def edit(self, kind: EditKind, object_id: str, value: str = "", author: str = "") -> EditEntry:
        """Correct an object, durably. value: see `Edit`; author: by default the user of this program."""
        ...

    def areas(self) -> tuple[Area, ...]:
        """Return the named areas."""
        ...

    def set_area(self, area: Area) -> None:
        """Add an area, or replace that of its name."""
        ...

    def remove_area(self, name: str) -> None:
        """Remove the area of a name."""
        ...


class RunMemory:
    """The ObjectMemory of a run's folder: object_edits.json and areas.json."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def edits(self) -> list[EditEntry]:
        """Return all edits, oldest first. Raises MapFileError."""
        return [EditEntry.of(number, edit) for number, edit in enumerate(read_edits(self._folder), 1)]

    def edit(self, kind: EditKind, object_id: str, value: str = "", author: str = "") -> EditEntry:
        """Correct an object. Raises InvalidInputError, MapFileError, StorageError."""
        edits = read_edits(self._folder)
        objects = apply_edits(reported_objects(self._folder), edits).objects
        made = new_edit(edits, objects, kind, object_id, value, author or getpass.getuser())
        write_edits(self._folder, (*edits, made))
        return EditEntry.of(len(edits) + 1, made)

    def areas(self) -> tuple[Area, ...]:
        """Return the named areas. Raises MapFileError."""
        return read_areas(self._folder)

    def set_area(self, area: Area) -> None:
        """Add or replace an area. Raises InvalidInputError, MapFileError, StorageError."""
        write_areas(self._folder, with_area(self.areas(), area))

    def remove_area(self, name: str) -> None:
        """Remove an area. Raises InvalidInputError, MapFileError, StorageError."""
        write_areas(self._folder, without_area(self.areas(), name))


def reported_objects(folder: Path) -> list[ObjectLandmark]:
    """Return the objects in a run's report.json, before edits. Raises InvalidInputError, CodecError."""
    values = read_report(folder).get("objects")
    if not isinstance(values, list):
        raise InvalidInputError(f"{folder}: expected a report.json with objects, got none")
    return [object_from_json(value) for value in values]


def new_edit(
    edits: Sequence[Edit], objects: Sequence[ObjectLandmark], kind: EditKind, object_id: str, value: str, author: str
) -> Edit:
    """Return an edit of an object as it is after the earlier edits. Raises InvalidInputError."""
    require_room(edits)
    now_ns = time.time_ns()
    if kind is EditKind.UNDO:
        number = object_id or value
        if not (number.isdecimal() and len(number) < _MAX_DIGITS and 1 <= int(number) <= len(edits)):
            raise InvalidInputError(
                f"undo: expected the number of an edit, 1 to {len(edits)}, got {quote_name(number)}"
            )
        return Edit(kind, author, now_ns, value=number)
    if kind in _NEEDS_VALUE and not value:
        raise InvalidInputError(f"{kind} {quote_name(object_id)}: expected a value, got none")
    target = _named(objects, object_id)
    other = _named(objects, value) if kind is EditKind.MERGE else None
    if other is not None:
        require_near(target, other)
    return Edit(kind, author, now_ns, target, value, other)


def _named(objects: Sequence[ObjectLandmark], name: str) -> ObjectLandmark:
    """Return the object of an id, or the only one of a noun. Raises InvalidInputError."""
    of_noun = [landmark for landmark in objects if landmark.noun == name]
    found = [landmark for landmark in objects if landmark.object_id == name] or of_noun
    if len(found) == 1:
        return found[0]
    known = ", ".join(landmark.object_id for landmark in (of_noun or objects)[:20]) or "none"
    raise InvalidInputError(f"object: expected one of {known}, got {quote_name(name)}")
