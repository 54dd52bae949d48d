"""`gausslite objects`: where the objects of a map are, or which of them a question means."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import object_as_json
from gausslite.codec.ply import read_ply
from gausslite.codec.run_files import read_keyframe_views
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.datasets.folder import read_pose_rows
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.objects import Answer, ObjectLandmark, ObjectReport, TeamObject
from gausslite.domain.pose import UpAxis, upward_axis
from gausslite.domain.task import TaskGraph
from gausslite.fusion.objects import merge_objects
from gausslite.mission.results import MAP, TRAJECTORY, as_text, read_report, stated_up
from gausslite.plugins import Group, load
from gausslite.wire.security import TlsFiles
from gausslite_language.rules import RuleParser
from gausslite_objects.edit_command import reported_objects
from gausslite_objects.edits import EditedObjects, apply_edits, read_edits
from gausslite_objects.life import Life, LifeState, life_of
from gausslite_objects.visit import Visit, depth_views, read_depths

_NS_PER_S = 1e9
_EPOCH_TIMES_S = 1e8
"""Larger times are counted from 1970."""
_MAX_LISTED = 20


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite objects`."""
    add = parser.add_argument
    add("place", metavar="HOST:PORT|FOLDER", help="a fusion server, or the output folder of `map` or an agent")
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


@dataclass(frozen=True, slots=True)
class _Place:
    """The objects of a map, with notes; of a folder also their lives and edits, and its last camera pose."""

    objects: Sequence[TeamObject]
    up_axis: UpAxis = (0.0, 0.0, 1.0)
    lives: Mapping[str, Life] = field(default_factory=dict)
    edited: EditedObjects = field(default_factory=lambda: apply_edits((), ()))
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    notes: tuple[str, ...] = ()


def run(options: argparse.Namespace) -> int:
    """Print the objects, the most confident first. Returns 0, or 1 if there is none."""
    folder = Path(options.place)
    place = _read_folder(folder) if folder.is_dir() else _query(options)
    objects, notes = _select(place, options.question)
    notes = (*notes, *place.notes)
    if options.json:
        values = [_as_json(found, place) for found in objects]
        print(as_text({"count": len(objects), "objects": values, "notes": list(notes)}))
    else:
        for found in objects:
            print(_describe(found, place))
        for note in notes:
            print(f"note: {note}")
        if options.question or not objects:
            print(_count(len(objects), options.question, place.objects))
    return 0 if objects else 1


def _select(place: _Place, question: str) -> tuple[Sequence[TeamObject], Sequence[str]]:
    """Return the objects that a noun or a question means, with notes. Raises InvalidInputError, TaskError."""
    if not question:
        return place.objects, ()
    try:
        graph = RuleParser().parse(question)
    except TaskError as error:
        raise InvalidInputError(f"QUESTION: {error}") from error
    by_id = {team_object.landmark.object_id: team_object for team_object in place.objects}
    answer: Callable[..., Answer] = load(Group.QUESTIONS, purpose="questions")
    found = answer(graph, [team_object.landmark for team_object in place.objects], place.up_axis, place.T_world_camera)
    return [by_id[landmark.object_id] for landmark in found.objects], found.notes


def _count(count: int, question: str, known: Sequence[TeamObject]) -> str:
    """Return how many objects were found; without any, also what the map has."""
    if count:
        return f"{count} object{'s' if count > 1 else ''}"
    nouns = sorted({team_object.landmark.noun for team_object in known})[:_MAX_LISTED]
    has = f"; the map has {', '.join(nouns)}" if nouns else ""
    return f"no object{f' for {quote_name(question)}' if question else ''}{has}"


def _query(options: argparse.Namespace) -> _Place:
    # imported late, because the objects of a folder need no gRPC
    from gausslite.wire.channel import require_callable
    from gausslite.wire.clients import FusionClient

    require_callable("a fusion server or the output folder of a run", options.place)
    with FusionClient(options.place, tls=build(TlsFiles, options).read()) as client:
        left_out = client.unlocalised()
        notes = tuple(f"the objects of {agent_id} are left out; {reason}" for agent_id, reason in left_out.items())
        return _Place(client.query_objects(), notes=notes)


def _read_folder(folder: Path) -> _Place:
    """Return the objects in report.json, with what the folder has of the map. Raises InvalidInputError, CodecError."""
    report, edited = read_report(folder), apply_edits(reported_objects(folder), read_edits(folder))
    agent_id = str(report.get("agent_id") or folder.resolve().name)
    targets = report.get("targets")
    nouns = tuple(str(target) for target in targets) if isinstance(targets, list) else ()
    graph = TaskGraph("", str(report.get("task") or ""), nouns, (), ())
    objects = merge_objects({agent_id: ObjectReport(graph, edited.objects)})
    trajectory = folder / TRAJECTORY
    poses = read_pose_rows(trajectory)[1] if trajectory.is_file() else np.zeros((0, 4, 4))
    return _Place(
        objects,
        stated_up(report) or upward_axis(poses),
        _lives(folder, edited.objects),
        edited,
        poses[-1] if len(poses) else None,
    )


def _lives(folder: Path, objects: Sequence[ObjectLandmark]) -> dict[str, Life]:
    """Return what the run's own depth says of each object by id; empty for a folder without a map or depth."""
    keyframes = read_keyframe_views(folder)
    depths_m = read_depths(folder, keyframes)
    if not depths_m or not (folder / MAP).is_file():
        return {}
    views, times_ns = depth_views(keyframes, depths_m)
    visit = Visit(read_ply(folder / MAP), objects, views, times_ns)
    return {found.object_id: life_of(visit.points_of(found), views, times_ns) for found in objects}


def _as_json(team_object: TeamObject, place: _Place) -> dict[str, object]:
    observers = [
        {
            "agent_id": observer.agent_id,
            "id": observer.object_id,
            "target": observer.target,
            "confidence": observer.confidence,
            "first_seen_ns": observer.first_seen_ns,
            "last_seen_ns": observer.last_seen_ns,
        }
        for observer in team_object.observers
    ]
    landmark = team_object.landmark
    life = place.lives.get(landmark.object_id)
    edited = {
        "life": None if life is None else life.as_json(),
        "pinned": landmark.object_id in place.edited.pinned,
        "notes": list(place.edited.notes.get(landmark.object_id, ())),
    }
    return {**object_as_json(landmark), **edited, "observers": observers}


def _describe(team_object: TeamObject, place: _Place) -> str:
    landmark = team_object.landmark
    centre = ", ".join(f"{value:.2f}" for value in landmark.centroid_m)
    size = " x ".join(f"{value:.2f}" for value in landmark.size_m)
    seen = "; ".join(
        f"{observer.agent_id} {_span(_time(observer.first_seen_ns), _time(observer.last_seen_ns))}"
        for observer in team_object.observers
    )
    return (
        f"{landmark.noun} ({landmark.role}) {landmark.object_id}: at ({centre}) m, size {size} m, "
        f"confidence {landmark.confidence:.2f}, seen by {seen}{_state(landmark, place)}"
    )


def _state(landmark: ObjectLandmark, place: _Place) -> str:
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
