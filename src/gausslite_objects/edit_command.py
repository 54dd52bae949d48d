"""`gausslite edit`: correct the objects of a run or of a team, name areas, or undo an edit."""

from __future__ import annotations

import argparse
import getpass

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError
from gausslite.wire.security import TlsFiles
from gausslite_objects.areas import Area, Point
from gausslite_objects.edits import EditKind
from gausslite_objects.mapped_objects import open_memory

_LIST, _AREA, _NO_AREA = "list", "area", "no-area"


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite edit`."""
    add = parser.add_argument
    add(
        "place", metavar="HOST:PORT|FOLDER", help="a fusion server, an agent, or the output folder of `map` or an agent"
    )
    kinds = [*map(str, EditKind), _AREA, _NO_AREA, _LIST]
    add("kind", choices=kinds, help="what to do; area: name a polygon on the floor; list: print edits and areas")
    object_help = "the object's id, or its noun if no other has it; the number of the edit to undo; the area's name"
    add("object", nargs="?", default="", help=object_help)
    values_help = (
        "the new noun, the note, the id of the object that is merged into this one, where to split (x=1.25; "
        "without it the middle of the longest side), or the corners X,Y,Z of the area"
    )
    add("values", nargs="*", metavar="VALUE", help=values_help)
    add("--author", default=getpass.getuser(), help="who edits (default: %(default)s)")
    add_flags(parser, TlsFiles)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Edit, and print what was done. Returns the exit code."""
    memory = open_memory(options.place, build(TlsFiles, options).read())
    if options.kind == _LIST:
        lines = [*(entry.describe() for entry in memory.edits()), *map(_describe, memory.areas())]
        print("\n".join(lines) or "no edits and no areas")
    elif options.kind == _AREA:
        area = Area(options.object, tuple(map(_corner, options.values)))
        memory.set_area(area)
        print(_describe(area))
    elif options.kind == _NO_AREA:
        memory.remove_area(options.object)
        print(f"area {quote_name(options.object)}: removed")
    else:
        edit = memory.edit(EditKind(options.kind), options.object, " ".join(options.values), options.author)
        print(edit.describe())
    return 0


def _describe(area: Area) -> str:
    corners = " ".join("({:.2f}, {:.2f}, {:.2f})".format(*corner) for corner in area.corners_m)
    return f"area {quote_name(area.name)}: {corners} m"


def _corner(text: str) -> Point:
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise InvalidInputError(f"area: expected corners X,Y,Z in metres, got {quote_name(text)}") from None
    return x, y, z
