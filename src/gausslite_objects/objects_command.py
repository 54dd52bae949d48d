"""`gausslite objects`: where the objects of a map are, or which of them a question means."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.domain.checks import quote_name
from gausslite.domain.objects import ObjectLandmark, TeamObject
from gausslite.mission.results import as_text
from gausslite.wire.security import TlsFiles
from gausslite_objects.life import LifeState
from gausslite_objects.mapped_objects import MappedObjects, as_json, query, read_folder, select

_NS_PER_S = 1e9
_EPOCH_TIMES_S = 1e8
"""Larger times are counted from 1970."""
_MAX_LISTED = 20


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite objects`."""
    add = parser.add_argument
    add("place", metavar="HOST:PORT|FOLDER", help="a fusion server, an agent, or the output folder of a run")
    add(
        "question",
        metavar="QUESTION",
        nargs="?",
        default="",
        help='a noun such as "mug", or a question such as "what is on the table" or "how many chairs are near the '
        'door" (default: all objects)',
    )
    add("--json", action="store_true", help="print JSON for scripts")
    add_flags(parser, TlsFiles)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the objects, the most confident first. Returns 0, or 1 if there is none."""
    folder = Path(options.place)
    place = read_folder(folder) if folder.is_dir() else query(options.place, build(TlsFiles, options).read())
    objects, notes = select(place, options.question)
    notes = (*notes, *place.notes)
    if options.json:
        values = [as_json(found, place) for found in objects]
        print(as_text({"count": len(objects), "objects": values, "notes": list(notes)}))
    else:
        for found in objects:
            print(_describe(found, place))
        for note in notes:
            print(f"note: {note}")
        if options.question or not objects:
            print(_count(len(objects), options.question, place.objects))
    return 0 if objects else 1


def _count(count: int, question: str, known: Sequence[TeamObject]) -> str:
    """Return how many objects were found; without any, also what the map has."""
    if count:
        return f"{count} object{'s' if count > 1 else ''}"
    nouns = sorted({team_object.landmark.noun for team_object in known})[:_MAX_LISTED]
    has = "; the map has " + (", ".join(nouns) or "none: two moments or places confirm an object")
    return f"no object{f' for {quote_name(question)}' if question else ''}{has}"


def _describe(team_object: TeamObject, place: MappedObjects) -> str:
    landmark = team_object.landmark
    centre = ", ".join(f"{value:.2f}" for value in landmark.centroid_m)
    size = " x ".join(f"{value:.2f}" for value in landmark.size_m)
    seen = "; ".join(
        f"{observer.agent_id} {_span(_time(observer.first_seen_ns), _time(observer.last_seen_ns))}"
        for observer in team_object.observers
    )
    return (
        f"{landmark.noun} ({landmark.role}) {landmark.object_id}: at ({centre}) m, size {size} m, "
        f"confidence {landmark.confidence:.2f}, seen by {seen or 'nobody now'}{_state(landmark, place)}"
    )


def _state(landmark: ObjectLandmark, place: MappedObjects) -> str:
    """Return what the views and people say of an object, after a comma; empty for one that is just present."""
    life = place.lives.get(landmark.object_id)
    parts = [] if life is None or life.state is LifeState.PRESENT else [str(life.state)]
    if life is not None and life.absent_ns is not None:
        parts.append(f"its place last seen empty at {_time(life.absent_ns)}")
    parts += ["pinned"] if landmark.object_id in place.edited.pinned else []
    parts += [f"note of {note}" for note in place.edited.notes.get(landmark.object_id, ())]
    return "".join(f", {part}" for part in parts)


def _span(first: str, last: str) -> str:
    return f"at {first}" if first == last else f"from {first} to {last}"


def _time(time_ns: int) -> str:
    """Return a capture time: as a date if the clock counts from 1970, else in seconds."""
    seconds = time_ns / _NS_PER_S
    if seconds < _EPOCH_TIMES_S:
        return f"{seconds:.1f} s"
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
