"""Read the objects of a place, a fusion server or a run's folder, and choose those that a question means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import object_as_json, object_from_json
from gausslite.codec.ply import read_ply
from gausslite.datasets.folder import read_pose_rows
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import Answer, ObjectReport, OrientedBox, TeamObject, oriented_box
from gausslite.domain.pose import UpAxis, upward_axis
from gausslite.domain.task import TaskGraph
from gausslite.fusion.objects import merge_objects
from gausslite.mission.results import TRAJECTORY, read_report, stated_up
from gausslite.plugins import Group, load
from gausslite.wire.security import Tls
from gausslite_language.rules import RuleParser


@dataclass(frozen=True, slots=True)
class MappedObjects:
    """The objects of a map, with notes; of a folder also its Gaussians and last camera pose, None if it has none."""

    objects: Sequence[TeamObject]
    up_axis: UpAxis = (0.0, 0.0, 1.0)
    targets: tuple[str, ...] = ()
    gaussians: Gaussians | None = None
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    notes: tuple[str, ...] = ()

    def box(self, team_object: TeamObject) -> OrientedBox | None:
        """Return the upright box of the object's own Gaussians, if the map has them."""
        if self.gaussians is None:
            return None
        return oriented_box(team_object.landmark, self.gaussians, self.targets, self.up_axis)


def query(address: str, tls: Tls | None) -> MappedObjects:
    """Return the team's objects of a fusion server. Raises InvalidInputError, UnavailableError."""
    # imported late, because the objects of a folder need no gRPC
    from gausslite.wire.channel import require_callable
    from gausslite.wire.clients import FusionClient

    require_callable("a fusion server or the output folder of a run", address)
    with FusionClient(address, tls=tls) as client:
        left_out = client.unlocalised()
        notes = tuple(f"the objects of {agent_id} are left out; {reason}" for agent_id, reason in left_out.items())
        return MappedObjects(client.query_objects(), notes=notes)


def read_folder(folder: Path) -> MappedObjects:
    """Return the objects in report.json, with what the folder has of the map. Raises InvalidInputError, CodecError."""
    report = read_report(folder)
    values = report.get("objects")
    if not isinstance(values, list):
        raise InvalidInputError(f"{folder}: expected a report.json with objects, got none")
    agent_id = str(report.get("agent_id") or folder.resolve().name)
    targets = report.get("targets")
    nouns = tuple(str(target) for target in targets) if isinstance(targets, list) else ()
    graph = TaskGraph("", str(report.get("task") or ""), nouns, (), ())
    objects = merge_objects({agent_id: ObjectReport(graph, tuple(object_from_json(value) for value in values))})
    map_file, trajectory = folder / "map.ply", folder / TRAJECTORY
    poses = read_pose_rows(trajectory)[1] if trajectory.is_file() else np.zeros((0, 4, 4))
    return MappedObjects(
        objects,
        stated_up(report) or upward_axis(poses),
        nouns,
        read_ply(map_file) if map_file.is_file() else None,
        poses[-1] if len(poses) else None,
    )


def select(place: MappedObjects, question: str) -> tuple[Sequence[TeamObject], Sequence[str]]:
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


def as_json(team_object: TeamObject, box: OrientedBox | None) -> dict[str, object]:
    """Return an object as JSON values, with its oriented box and who observed it."""
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
    oriented = {} if box is None else {"yaw_rad": box.yaw_rad, "oriented_size_m": list(box.size_m)}
    return {**object_as_json(team_object.landmark), **oriented, "observers": observers}
