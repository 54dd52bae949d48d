"""Convert between task graphs and their messages; values from outside are checked here."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from gausslite.domain.checks import require_types
from gausslite.domain.errors import InvalidInputError, TaskError
from gausslite.domain.objects import (
    MAX_OBJECT_COORDINATE_M,
    MAX_OBJECTS_PER_AGENT,
    ObjectLandmark,
    ObjectObserver,
    ObjectReport,
    ObjectRole,
    TeamObject,
)
from gausslite.domain.relevance import UNNAMED, PointedObject, PointM
from gausslite.domain.task import (
    ObjectAttributes,
    Predicate,
    Relation,
    Superlative,
    TargetRole,
    TaskGraph,
    noun_of,
    require_graph,
)
from gausslite.v1 import agent_service_pb2, fusion_service_pb2, geometry_pb2, objects_pb2, task_pb2
from gausslite.wire.convert import (
    box_from_message,
    box_to_message,
    enum_numbers,
    point_from_message,
    point_to_message,
    values_of,
)

_MAX_LISTED: Final = 256
_MAX_POINTED: Final = 64
"""Points and boxes of a task in all; a region grows around each of them, on the thread that maps frames."""


_PREDICATE_NUMBERS = enum_numbers(task_pb2.Predicate, Predicate)
_ROLE_NUMBERS = enum_numbers(task_pb2.TargetRole, TargetRole)
_SUPERLATIVE_NUMBERS: dict[Any, Any] = {None: 0, **enum_numbers(task_pb2.Superlative, Superlative)}
_PREDICATE_BY_NUMBER = {number: predicate for predicate, number in _PREDICATE_NUMBERS.items()}
_ROLE_BY_NUMBER = {0: TargetRole.OBJECT, **{number: role for role, number in _ROLE_NUMBERS.items()}}
_SUPERLATIVE_BY_NUMBER = {number: superlative for superlative, number in _SUPERLATIVE_NUMBERS.items()}
_NAMES = ("targets", "anchors", "warnings", "excluded", "context")
_RELATION = ("target", "anchor", "negated", "min_m", "max_m")
_ROLES = enum_numbers(objects_pb2.ObjectRole, ObjectRole)
_OBJECT_ROLE_BY_NUMBER = {number: role for role, number in _ROLES.items()}
_LANDMARK = ("noun", "confidence", "first_seen_ns", "last_seen_ns")
_OBSERVER = tuple(field.name for field in fields(ObjectObserver))


def graph_to_message(graph: TaskGraph) -> task_pb2.TaskGraph:
    """Encode a task graph."""
    relations = [
        task_pb2.Relation(**values_of(relation, _RELATION), predicate=_PREDICATE_NUMBERS[relation.predicate])
        for relation in graph.relations
    ]
    attributes = [
        task_pb2.ObjectAttributes(
            name=attribute.name, colour=attribute.colour or "", superlative=_SUPERLATIVE_NUMBERS[attribute.superlative]
        )
        for attribute in graph.attributes
    ]
    return task_pb2.TaskGraph(
        **values_of(graph, ("task_id", "text", *_NAMES)),
        relations=relations,
        roles=[_ROLE_NUMBERS[role] for role in graph.roles],
        attributes=attributes,
    )


def graph_from_message(message: task_pb2.TaskGraph) -> TaskGraph:
    """Decode a task graph and check it with `domain.task_limits`. Raises TaskError."""
    names = {name: tuple(values) for name, values in values_of(message, _NAMES).items()}
    _require_few(message.relations, message.roles, message.attributes, *names.values())
    _require_known_numbers(message)
    graph = TaskGraph(
        task_id=message.task_id,
        text=message.text,
        relations=tuple(_relation_from_message(relation) for relation in message.relations),
        roles=tuple(_ROLE_BY_NUMBER[role] for role in message.roles),
        attributes=tuple(
            ObjectAttributes(attribute.name, attribute.colour or None, _SUPERLATIVE_BY_NUMBER[attribute.superlative])
            for attribute in message.attributes
        ),
        **names,
    )
    require_graph(graph)
    return graph


@dataclass(frozen=True, slots=True)
class AssignedTask:
    """An AssignTask call: a graph (None: the current task), objects pointed at, and points on excluded ones."""

    graph: TaskGraph | None
    pointed: tuple[PointedObject, ...] = ()
    excluded_m: tuple[PointM, ...] = ()

    def __post_init__(self) -> None:
        if self.graph is None and not (self.pointed or self.excluded_m):
            raise InvalidInputError("task: expected a text, a graph or points, got none")
        marks = sum(max(len(shown.points_px) + len(shown.boxes_px), 1) for shown in self.pointed)
        if max(marks, len(self.excluded_m)) > _MAX_POINTED:
            raise InvalidInputError(
                f"task: expected at most {_MAX_POINTED} points and boxes or excluded ones, got more"
            )


def assigned_to_message(
    task: str | TaskGraph | None, pointed: Sequence[PointedObject] = (), excluded_m: Sequence[PointM] = ()
) -> agent_service_pb2.AssignTaskRequest:
    """Encode the request of an AssignTask call. Raises InvalidInputError."""
    request = agent_service_pb2.AssignTaskRequest(
        pointed=map(_pointed_to_message, pointed), excluded=map(point_to_message, excluded_m)
    )
    if isinstance(task, str):
        request.text = task
    elif task is not None:
        require_types(task=(task, TaskGraph))
        request.graph.CopyFrom(graph_to_message(task))
    return request


def assigned_from_message(
    message: agent_service_pb2.AssignTaskRequest, parse: Callable[[str], TaskGraph]
) -> AssignedTask:
    """Decode the request of an AssignTask call; a text is parsed. Raises TaskError, InvalidInputError."""
    _require_few(message.pointed, message.excluded)
    pointed = tuple(map(_pointed_from_message, message.pointed))
    excluded_m = tuple(_surface_point_from_message("excluded", point) for point in message.excluded)
    kind = message.WhichOneof("task")
    if kind == "text":
        return AssignedTask(parse(message.text), pointed, excluded_m)
    return AssignedTask(graph_from_message(message.graph) if kind else None, pointed, excluded_m)


def _pointed_to_message(pointed: PointedObject) -> agent_service_pb2.PointedObject:
    return agent_service_pb2.PointedObject(
        frame_index=pointed.frame_index,
        points_px=[value for point in pointed.points_px for value in point],
        boxes_px=[value for box in pointed.boxes_px for value in box],
        point_m=None if pointed.point_m is None else point_to_message(pointed.point_m),
        noun=pointed.noun,
    )


def _pointed_from_message(message: agent_service_pb2.PointedObject) -> PointedObject:
    points, boxes = np.array(message.points_px), np.array(message.boxes_px)
    if len(points) % 2 or len(boxes) % 4 or not np.isfinite([*points, *boxes]).all():
        raise InvalidInputError("pointed object: expected two finite numbers a point and four a box, got others")
    return PointedObject(
        tuple((x, y) for x, y in points.reshape(-1, 2).tolist()),
        tuple((left, top, right, bottom) for left, top, right, bottom in boxes.reshape(-1, 4).tolist()),
        _surface_point_from_message("point_m", message.point_m) if message.HasField("point_m") else None,
        message.frame_index if message.HasField("frame_index") else None,
        noun_of(message.noun) or UNNAMED,
    )


def _surface_point_from_message(name: str, message: geometry_pb2.Point) -> PointM:
    """Decode a point on a surface. Raises InvalidInputError."""
    point_m = point_from_message(message)
    if not all(abs(value) <= MAX_OBJECT_COORDINATE_M for value in point_m):
        raise InvalidInputError(f"{name}: expected coordinates within ±{MAX_OBJECT_COORDINATE_M:g} m, got {point_m}")
    return point_m


def _require_few(*lists: Sized) -> None:
    """Raise TaskError for more than any task has, before anything is made of it."""
    if (longest := max(map(len, lists))) > _MAX_LISTED:
        raise TaskError(f"task: expected at most {_MAX_LISTED} objects, relations or points, got {longest}")


def _require_known_numbers(message: task_pb2.TaskGraph) -> None:
    for name, kind, numbers, known in (
        ("relation", Predicate, [relation.predicate for relation in message.relations], _PREDICATE_BY_NUMBER),
        ("roles", TargetRole, message.roles, _ROLE_BY_NUMBER),
        ("attributes", Superlative, [own.superlative for own in message.attributes], _SUPERLATIVE_BY_NUMBER),
    ):
        for number in numbers:
            if number not in known:
                raise TaskError(f"task {name}: expected one of {', '.join(kind)}, got {kind.__name__} {number}")


def _relation_from_message(message: task_pb2.Relation) -> Relation:
    return Relation(
        _PREDICATE_BY_NUMBER[message.predicate],
        **values_of(message, ("target", "anchor", "negated")),
        min_m=message.min_m if message.HasField("min_m") else None,
        max_m=message.max_m if message.HasField("max_m") else None,
    )


def object_to_message(landmark: ObjectLandmark, observers: Sequence[ObjectObserver] = ()) -> objects_pb2.ObjectLandmark:
    """Encode an object; without observers, as one agent reports it."""
    return objects_pb2.ObjectLandmark(
        id=landmark.object_id,
        **values_of(landmark, _LANDMARK),
        role=_ROLES[landmark.role],
        centroid_m=point_to_message(landmark.centroid_m),
        extent_m=box_to_message(landmark.extent_m),
        observers=[objects_pb2.ObjectObserver(**values_of(observer, _OBSERVER)) for observer in observers],
    )


def object_from_message(message: objects_pb2.ObjectLandmark) -> ObjectLandmark:
    """Decode an object without its observers. Raises InvalidInputError."""
    role = _OBJECT_ROLE_BY_NUMBER.get(message.role)
    if role is None:
        raise InvalidInputError(f"object role: expected TARGET, ANCHOR or OTHER, got {message.role}")
    return ObjectLandmark(
        object_id=message.id,
        role=role,
        centroid_m=point_from_message(message.centroid_m),
        extent_m=box_from_message(message.extent_m),
        **values_of(message, _LANDMARK),
    )


def team_object_from_message(message: objects_pb2.ObjectLandmark) -> TeamObject:
    """Decode an object of the team. Raises InvalidInputError."""
    observers = tuple(ObjectObserver(**values_of(own, _OBSERVER)) for own in message.observers)
    return TeamObject(object_from_message(message), observers)


def report_to_message(session_id: str, report: ObjectReport) -> fusion_service_pb2.ReportObjectsRequest:
    """Encode an agent's report."""
    return fusion_service_pb2.ReportObjectsRequest(
        session_id=session_id,
        task=graph_to_message(report.graph),
        objects=[object_to_message(landmark) for landmark in report.objects],
    )


def report_from_message(message: fusion_service_pb2.ReportObjectsRequest) -> ObjectReport:
    """Decode an agent's report; its size is checked first. Raises TaskError, InvalidInputError."""
    if len(message.objects) > MAX_OBJECTS_PER_AGENT:
        raise InvalidInputError(f"objects: expected at most {MAX_OBJECTS_PER_AGENT}, got {len(message.objects)}")
    return ObjectReport(
        graph_from_message(message.task), tuple(object_from_message(landmark) for landmark in message.objects)
    )
