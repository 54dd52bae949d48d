"""Read the objects of a place, a running service or a run's folder, and choose those that a question means."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import object_as_json
from gausslite.codec.ply import read_ply
from gausslite.codec.run_files import read_keyframe_views
from gausslite.datasets.pose_track import read_pose_rows
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.objects import Answer, ObjectLandmark, ObjectReport, TeamObject
from gausslite.domain.pose import UpAxis, upward_axis
from gausslite.domain.task import Predicate, TaskGraph
from gausslite.mission.results import MAP, TRAJECTORY, read_report
from gausslite.plugins import Group, load
from gausslite.wire.security import Tls
from gausslite_language.rules import RuleParser
from gausslite_objects.areas import Area, NamedPlaces, describe_unknown, read_areas
from gausslite_objects.edits import EditedObjects, apply_edits, read_edits
from gausslite_objects.life import Life, life_of
from gausslite_objects.object_memory import ObjectMemory, RunMemory, reported_objects
from gausslite_objects.team_objects import merge_objects
from gausslite_objects.visit import Visit, depth_views, read_depths, stated_up


@dataclass(frozen=True, slots=True)
class MappedObjects:
    """The objects of a map after edits, its areas, and notes; of a folder also lives, and its last camera pose."""

    objects: Sequence[TeamObject]
    up_axis: UpAxis = (0.0, 0.0, 1.0)
    lives: Mapping[str, Life] = field(default_factory=dict)
    edited: EditedObjects = field(default_factory=lambda: apply_edits((), ()))
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    notes: tuple[str, ...] = ()
    areas: tuple[Area, ...] = ()


def query(address: str, tls: Tls | None) -> MappedObjects:
    """Return the objects of a fusion server's team, or of an agent. Raises InvalidInputError, UnavailableError."""
    # imported late, because the objects of a folder need no gRPC
    from gausslite.wire.channel import is_agent, require_callable
    from gausslite_objects.memory_client import ServerMemory

    require_callable("no such folder; a fusion server or an agent", address)
    found = (_of_agent if is_agent(address, tls) else _of_team)(address, tls)
    remarks, areas = ServerMemory(address, tls).remarks()
    said = {name: own.notes for name, own in remarks.items()}
    pinned = frozenset(name for name, own in remarks.items() if own.is_pinned)
    edited = EditedObjects(tuple(own.landmark for own in found.objects), said, pinned, {})
    return replace(found, edited=edited, areas=areas)


def _of_team(address: str, tls: Tls | None) -> MappedObjects:
    from gausslite.wire.clients import FusionClient

    with FusionClient(address, tls=tls) as client:
        left_out = client.unlocalised()
        notes = tuple(f"the objects of {agent_id} are left out; {reason}" for agent_id, reason in left_out.items())
        return MappedObjects(client.query_objects(), notes=notes)


def _of_agent(address: str, tls: Tls | None) -> MappedObjects:
    from gausslite.wire.clients import AgentClient
    from gausslite.wire.convert import transform_from_message
    from gausslite.wire.convert_task import graph_from_message, object_from_message

    with AgentClient(address, tls=tls) as client:
        status, path = client.status(), client.camera_view().path
    report = ObjectReport(graph_from_message(status.graph), tuple(map(object_from_message, status.objects)))
    poses = np.reshape([transform_from_message("path", stamped.t_world_camera) for stamped in path], (-1, 4, 4))
    last = poses[-1] if len(poses) else None
    return MappedObjects(merge_objects({status.agent_id: report}), upward_axis(poses), T_world_camera=last)


def read_folder(folder: Path) -> MappedObjects:
    """Return the objects in report.json, with what the folder has of the map. Raises InvalidInputError, CodecError."""
    report, edited = read_report(folder), apply_edits(reported_objects(folder), read_edits(folder))
    agent_id = str(report.get("agent_id") or folder.resolve().name)
    targets = report.get("targets")
    nouns = tuple(str(target) for target in targets) if isinstance(targets, list) else ()
    graph = TaskGraph("", str(report.get("task") or ""), nouns, (), ())
    objects = merge_objects({agent_id: ObjectReport(graph, edited.objects)})
    trajectory = folder / TRAJECTORY
    poses = read_pose_rows(trajectory)[1] if trajectory.is_file() else np.zeros((0, 4, 4))
    return MappedObjects(
        objects,
        stated_up(report) or upward_axis(poses),
        _lives(folder, edited.objects),
        edited,
        poses[-1] if len(poses) else None,
        areas=read_areas(folder),
    )


def open_memory(place: str, tls: Tls | None = None) -> ObjectMemory:
    """Return the memory of a run's folder, or of a fusion server or an agent at HOST:PORT. Raises InvalidInputError."""
    if Path(place).is_dir():
        return RunMemory(Path(place))
    # imported late, because the objects of a folder need no gRPC
    from gausslite.wire.channel import require_callable
    from gausslite_objects.memory_client import ServerMemory

    require_callable("no such folder; a fusion server or an agent", place)
    return ServerMemory(place, tls)


def select(place: MappedObjects, question: str) -> tuple[Sequence[TeamObject], Sequence[str]]:
    """Return the objects that a noun or a question means, with notes; of areas that it names, only those there.

    Raises InvalidInputError, TaskError.
    """
    named = NamedPlaces.of(question, place.areas)
    objects = [found for found in place.objects if named.contain(found.landmark.centroid_m, place.up_axis)]
    if not named.question:
        return objects, ()
    try:
        graph = RuleParser().parse(named.question)
    except TaskError as error:
        raise InvalidInputError(f"QUESTION: {error}") from error
    by_id = {team_object.landmark.object_id: team_object for team_object in objects}
    answer: Callable[..., Answer] = load(Group.QUESTIONS, purpose="questions")

    def ask(asked: Sequence[TeamObject]) -> Answer:
        return answer(graph, [own.landmark for own in asked], place.up_axis, place.T_world_camera)

    found = ask(objects)
    if not found.objects and (elsewhere := ask(place.objects).objects):
        return (), (named.left_out_note([landmark.centroid_m for landmark in elsewhere], place.up_axis),)
    anchors = [own.anchor for own in graph.relations if own.predicate is Predicate.INSIDE and not found.objects]
    unknown = [describe_unknown(name, place.areas) for name in dict.fromkeys((*graph.context, *anchors))]
    return [by_id[landmark.object_id] for landmark in found.objects], (*found.notes, *unknown)


def as_json(team_object: TeamObject, place: MappedObjects) -> dict[str, object]:
    """Return an object as JSON values, with what views and people say of it, and who observed it."""
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


def _lives(folder: Path, objects: Sequence[ObjectLandmark]) -> dict[str, Life]:
    """Return what the run's own depth says of each object by id; empty for a folder without a map or depth."""
    keyframes = read_keyframe_views(folder)
    depths_m = read_depths(folder, keyframes)
    if not depths_m or not (folder / MAP).is_file():
        return {}
    visit = Visit(read_ply(folder / MAP), objects, *depth_views(keyframes, depths_m))
    return {found.object_id: life_of(visit.points_of(found), visit) for found in objects}
