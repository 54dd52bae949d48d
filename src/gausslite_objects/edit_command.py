"""`gausslite edit`: correct the objects of a run: delete, rename, merge, pin, note, or undo an edit."""

from __future__ import annotations

import argparse
import getpass
import json
import time
from collections.abc import Sequence
from pathlib import Path

from gausslite.codec.json import object_from_json
from gausslite.config.command_parser import CommandParser
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import ObjectLandmark
from gausslite.mission.results import read_report
from gausslite_objects.edits import Edit, EditKind, add_edit, apply_edits, read_edits

_NEEDS_VALUE = (EditKind.RENAME, EditKind.MERGE, EditKind.NOTE)


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite edit`."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="output folder of `map` or an agent")
    parser.add_argument("kind", choices=[*map(str, EditKind), "list"], help="what to do; list: print the edits")
    parser.add_argument(
        "object",
        nargs="?",
        default="",
        help="the object's id, as `gausslite objects RUN` prints it, or the number of the edit to undo",
    )
    parser.add_argument(
        "value",
        nargs="?",
        default="",
        help="the new noun, the note, or the id of the object that is merged into this one",
    )
    parser.add_argument("--author", default=getpass.getuser(), help="who edits (default: %(default)s)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Edit, and print what was done. Returns the exit code."""
    if options.kind == "list":
        for number, edit in enumerate(read_edits(options.run_folder), 1):
            print(f"{number}: {_describe(edit)}")
        return 0
    edit = edit_of(options.run_folder, EditKind(options.kind), options.object, options.value, options.author)
    print(f"{add_edit(options.run_folder, edit)}: {_describe(edit)}")
    return 0


def edit_of(folder: Path, kind: EditKind, object_id: str, value: str, author: str) -> Edit:
    """Return an edit of an object of a run, as it is after the earlier edits. Raises InvalidInputError."""
    now_ns = time.time_ns()
    if kind is EditKind.UNDO:
        return Edit(kind, author, now_ns, value=object_id)
    if kind in _NEEDS_VALUE and not value:
        raise InvalidInputError(f"{kind} {quote_name(object_id)}: expected a value, got none")
    objects = apply_edits(reported_objects(folder), read_edits(folder)).objects
    target = _with_id(objects, object_id)
    other = _with_id(objects, value) if kind is EditKind.MERGE else None
    return Edit(kind, author, now_ns, target, value, other)


def reported_objects(folder: Path) -> list[ObjectLandmark]:
    """Return the objects in a run's report.json, before edits. Raises InvalidInputError, CodecError."""
    values = read_report(folder).get("objects")
    if not isinstance(values, list):
        raise InvalidInputError(f"{folder}: expected a report.json with objects, got none")
    return [object_from_json(value) for value in values]


def _with_id(objects: Sequence[ObjectLandmark], object_id: str) -> ObjectLandmark:
    for landmark in objects:
        if landmark.object_id == object_id:
            return landmark
    known = ", ".join(landmark.object_id for landmark in objects[:20]) or "none"
    raise InvalidInputError(f"object: expected one of {known}, got {quote_name(object_id)}")


def _describe(edit: Edit) -> str:
    what = edit.value if edit.target is None else json.dumps(edit.target.object_id)
    to = f" as {quote_name(edit.value)}" if edit.target is not None and edit.value else ""
    return f"{edit.kind} {what}{to}, by {edit.author}"
