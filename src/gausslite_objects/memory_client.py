"""The edits and areas of a fusion server or an agent, by its MemoryService."""

from __future__ import annotations

import getpass
from dataclasses import dataclass
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.v1 import memory_service_pb2 as pb
from gausslite.v1 import memory_service_pb2_grpc as pb_grpc
from gausslite.wire.channel import ServiceChannel
from gausslite.wire.convert import enum_numbers, point_from_message, point_to_message, values_of
from gausslite.wire.security import Tls
from gausslite_objects.areas import Area
from gausslite_objects.edits import EditKind
from gausslite_objects.object_memory import EditEntry

KIND_NUMBERS = enum_numbers(pb.EditKind, EditKind)
_KINDS = {number: kind for kind, number in KIND_NUMBERS.items()}
_ENTRY = ("number", "object_id", "value", "author", "time_ns")


@dataclass(frozen=True, slots=True)
class Remarks:
    """What people said of one object."""

    is_pinned: bool
    notes: tuple[str, ...]


class MemoryClient(ServiceChannel):
    """Calls MemoryService."""

    kind = "service"

    def __init__(self, address: str, tls: Tls | None = None) -> None:
        super().__init__(address, tls=tls)
        self._stub = pb_grpc.MemoryServiceStub(self._channel)

    def read(self, mission_id: str = "", agent_id: str = "") -> pb.GetMemoryResponse:
        """Return edits, areas and remarks; of an agent the areas alone, in the frame of its map.

        Raises InvalidInputError where the server has no such service.
        """
        request = pb.GetMemoryRequest(mission_id=mission_id, agent_id=agent_id)
        return self._call(self._stub.GetMemory, request)

    def edit(self, kind: EditKind, object_id: str, value: str, author: str) -> EditEntry:
        """Correct an object."""
        kind_number = KIND_NUMBERS[kind]
        request = pb.EditObjectRequest(kind=kind_number, object_id=object_id, value=value, author=author)
        return entry_from_message(self._call(self._stub.EditObject, request).edit)

    def set_area(self, area: pb.Area) -> None:
        """Name an area, or remove that of the name."""
        self._call(self._stub.SetArea, pb.SetAreaRequest(area=area))


class ServerMemory:
    """The ObjectMemory of a fusion server or an agent; each call has a channel of its own."""

    def __init__(self, address: str, tls: Tls | None = None) -> None:
        self._address, self._tls = address, tls

    def edits(self) -> list[EditEntry]:
        """Return all edits, oldest first."""
        with self._client() as client:
            return [entry_from_message(edit) for edit in client.read().edits]

    def edit(self, kind: EditKind, object_id: str, value: str = "", author: str = "") -> EditEntry:
        """Correct an object. author: the server takes the names of the certificate if there is one."""
        with self._client() as client:
            return client.edit(kind, object_id, value, author or getpass.getuser())

    def areas(self) -> tuple[Area, ...]:
        """Return the named areas."""
        with self._client() as client:
            return tuple(map(area_from_message, client.read().areas))

    def set_area(self, area: Area) -> None:
        """Add or replace an area."""
        with self._client() as client:
            client.set_area(area_to_message(area))

    def remove_area(self, name: str) -> None:
        """Remove an area."""
        with self._client() as client:
            client.set_area(pb.Area(name=name))

    def remarks(self) -> tuple[dict[str, Remarks], tuple[Area, ...]]:
        """Return what people said of each object, and the areas; none of a server without the service."""
        try:
            with self._client() as client:
                memory = client.read()
        except InvalidInputError:
            return {}, ()
        remarks = {own.object_id: Remarks(own.is_pinned, tuple(own.notes)) for own in memory.remarks}
        return remarks, tuple(map(area_from_message, memory.areas))

    def _client(self) -> MemoryClient:
        return MemoryClient(self._address, self._tls)


def entry_to_message(entry: EditEntry) -> pb.ObjectEdit:
    """Encode an edit."""
    return pb.ObjectEdit(kind=KIND_NUMBERS[entry.kind], **values_of(entry, _ENTRY))


def entry_from_message(message: pb.ObjectEdit) -> EditEntry:
    """Decode an edit. Raises InvalidInputError."""
    return EditEntry(kind=kind_from_number(message.kind), **values_of(message, _ENTRY))


def kind_from_number(number: Any) -> EditKind:
    """Return the kind of edit. Raises InvalidInputError."""
    if number not in _KINDS:
        raise InvalidInputError(f"edit kind: expected one of {', '.join(map(str, EditKind))}, got {number}")
    return _KINDS[number]


def area_to_message(area: Area) -> pb.Area:
    """Encode an area."""
    return pb.Area(name=area.name, corners_m=[point_to_message(corner) for corner in area.corners_m])


def area_from_message(message: pb.Area) -> Area:
    """Decode an area. Raises InvalidInputError."""
    return Area(message.name, tuple(point_from_message(corner) for corner in message.corners_m))
