"""`gausslite objects`: where the objects of a task are, from a fusion server or from the report of a run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gausslite.codec.object_report import object_as_json, object_from_json
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import quote_name
from gausslite.domain.objects import ObjectReport, TeamObject
from gausslite.domain.task import TaskGraph
from gausslite.fusion.team_objects import find_objects
from gausslite.mission.results import as_text, read_report
from gausslite.wire.tls import TlsFiles

_NS_PER_S = 1e9


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite objects`."""
    add = parser.add_argument
    add("place", metavar="HOST:PORT|FOLDER", help="a fusion server, or the output folder of `map` or an agent")
    add("noun", metavar="NOUN", nargs="?", default="", help='a noun phrase such as "mug" (default: all objects)')
    add("--json", action="store_true", help="print JSON for scripts")
    add_flags(parser, TlsFiles)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the objects, the most confident first. Returns 0, or 1 if there is none."""
    folder = Path(options.place)
    objects = _read_folder(folder, options.noun) if folder.is_dir() else _query(options)
    if options.json:
        print(as_text({"objects": [_as_json(each) for each in objects]}))
    else:
        print("\n".join(_describe(each) for each in objects) or _no_object(options.noun))
    return 0 if objects else 1


def _no_object(noun: str) -> str:
    return f"no object {quote_name(noun)}" if noun else "no object"


def _query(options: argparse.Namespace) -> Sequence[TeamObject]:
    # imported late, because the objects of a folder need no gRPC
    from gausslite.wire.address import require_callable
    from gausslite.wire.clients import FusionClient

    require_callable("a fusion server or the output folder of a run", options.place)
    with FusionClient(options.place, tls=build(TlsFiles, options).read()) as client:
        return client.query_objects(options.noun)


def _read_folder(folder: Path, noun: str) -> Sequence[TeamObject]:
    """Return the objects in report.json. Raises InvalidInputError, CodecError."""
    report = read_report(folder)
    values = report.get("objects")
    if not isinstance(values, list):
        raise InvalidInputError(f"{folder}: expected a report.json with objects, got none")
    agent_id = str(report.get("agent_id") or folder.resolve().name)
    targets = report.get("targets")
    nouns = tuple(str(each) for each in targets) if isinstance(targets, list) else ()
    graph = TaskGraph("", str(report.get("task") or ""), nouns, (), ())
    return find_objects({agent_id: ObjectReport(graph, tuple(object_from_json(each) for each in values))}, {}, noun)


def _as_json(team_object: TeamObject) -> dict[str, object]:
    observers = [
        {
            "agent_id": each.agent_id,
            "id": each.object_id,
            "target": each.target,
            "confidence": each.confidence,
            "first_seen_ns": each.first_seen_ns,
            "last_seen_ns": each.last_seen_ns,
        }
        for each in team_object.observers
    ]
    return {**object_as_json(team_object.landmark), "observers": observers}


def _describe(team_object: TeamObject) -> str:
    landmark = team_object.landmark
    place = ", ".join(f"{value:.2f}" for value in landmark.centroid_m)
    size = " x ".join(f"{value:.2f}" for value in landmark.size_m)
    seen = "; ".join(
        f"{each.agent_id} from {each.first_seen_ns / _NS_PER_S:.1f} s to {each.last_seen_ns / _NS_PER_S:.1f} s"
        for each in team_object.observers
    )
    return (
        f"{landmark.noun} ({landmark.role}) {landmark.object_id}: at ({place}) m, size {size} m, "
        f"confidence {landmark.confidence:.2f}, seen by {seen}"
    )
