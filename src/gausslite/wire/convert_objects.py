"""Convert between protobuf messages and object landmarks; values from outside are checked here."""

from __future__ import annotations

from collections.abc import Sequence

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import (
    MAX_OBJECTS_PER_AGENT,
    ObjectLandmark,
    ObjectObserver,
    ObjectReport,
    ObjectRole,
    TeamObject,
)
from gausslite.v1 import fusion_service_pb2, geometry_pb2, objects_pb2
from gausslite.wire.convert import box_from_message, box_to_message
from gausslite.wire.convert_task import graph_from_message, graph_to_message

_ROLES = {ObjectRole.TARGET: objects_pb2.OBJECT_ROLE_TARGET, ObjectRole.ANCHOR: objects_pb2.OBJECT_ROLE_ANCHOR}
_ROLE_BY_NUMBER = {number: role for role, number in _ROLES.items()}


def object_to_message(landmark: ObjectLandmark, observers: Sequence[ObjectObserver] = ()) -> objects_pb2.ObjectLandmark:
    """Encode an object; without observers, as one agent reports it."""
    x, y, z = landmark.centroid_m
    return objects_pb2.ObjectLandmark(
        id=landmark.object_id,
        noun=landmark.noun,
        role=_ROLES[landmark.role],
        centroid_m=geometry_pb2.Point(x=x, y=y, z=z),
        extent_m=box_to_message(landmark.extent_m),
        confidence=landmark.confidence,
        first_seen_ns=landmark.first_seen_ns,
        last_seen_ns=landmark.last_seen_ns,
        observers=[
            objects_pb2.ObjectObserver(
                agent_id=each.agent_id,
                object_id=each.object_id,
                target=each.target,
                confidence=each.confidence,
                first_seen_ns=each.first_seen_ns,
                last_seen_ns=each.last_seen_ns,
            )
            for each in observers
        ],
    )


def object_from_message(message: objects_pb2.ObjectLandmark) -> ObjectLandmark:
    """Decode an object without its observers. Raises InvalidInputError."""
    role = _ROLE_BY_NUMBER.get(message.role)
    if role is None:
        raise InvalidInputError(f"object role: expected TARGET or ANCHOR, got {message.role}")
    centroid = message.centroid_m
    return ObjectLandmark(
        object_id=message.id,
        noun=message.noun,
        role=role,
        centroid_m=(centroid.x, centroid.y, centroid.z),
        extent_m=box_from_message(message.extent_m),
        confidence=message.confidence,
        first_seen_ns=message.first_seen_ns,
        last_seen_ns=message.last_seen_ns,
    )


def team_object_from_message(message: objects_pb2.ObjectLandmark) -> TeamObject:
    """Decode an object of the team. Raises InvalidInputError."""
    observers = tuple(
        ObjectObserver(
            each.agent_id, each.object_id, each.target, each.confidence, each.first_seen_ns, each.last_seen_ns
        )
        for each in message.observers
    )
    return TeamObject(object_from_message(message), observers)


def report_to_message(session_id: str, report: ObjectReport) -> fusion_service_pb2.ReportObjectsRequest:
    """Encode an agent's report."""
    return fusion_service_pb2.ReportObjectsRequest(
        session_id=session_id,
        task=graph_to_message(report.graph),
        objects=[object_to_message(each) for each in report.objects],
    )


def report_from_message(message: fusion_service_pb2.ReportObjectsRequest) -> ObjectReport:
    """Decode an agent's report; its size is checked first. Raises TaskError, InvalidInputError."""
    if len(message.objects) > MAX_OBJECTS_PER_AGENT:
        raise InvalidInputError(f"objects: expected at most {MAX_OBJECTS_PER_AGENT}, got {len(message.objects)}")
    return ObjectReport(graph_from_message(message.task), tuple(object_from_message(each) for each in message.objects))
