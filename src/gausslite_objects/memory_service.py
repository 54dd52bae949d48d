"""The methods of MemoryService, and what it serves of a fusion server: edits and areas of a mission, in its store.

`memory_service` is a plug-in of the group `gausslite.server_services`.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, Protocol

from gausslite.domain.pose import inverse
from gausslite.fusion.engine import FusionEngine
from gausslite.v1 import memory_service_pb2 as pb
from gausslite.v1 import memory_service_pb2_grpc as pb_grpc
from gausslite.wire.security import Caller
from gausslite.wire.server import Service
from gausslite.wire.worker_pool import WorkerPool
from gausslite_fusion_server.plugins import FindEngine
from gausslite_objects.areas import Area, decode_areas, encode_areas, with_area, without_area
from gausslite_objects.edits import Edit, EditedObjects, apply_edits, decode_edits, encode_edits
from gausslite_objects.memory_client import area_from_message, area_to_message, entry_to_message, kind_from_number
from gausslite_objects.object_memory import EditEntry, new_edit
from gausslite_objects.team_objects import EDITS_RECORD, MergedObjects

# ruff: noqa: N802 - the methods' names are those of the generated base class

_AREAS_RECORD = "areas"
_NOBODY = ""
"""The mission's own records belong to no agent."""
_log = logging.getLogger(__name__)


class ServedPlace(Protocol):
    """Where a running service keeps edits and areas. Its methods may block, and raise GaussLiteError."""

    def edits(self) -> tuple[Edit, ...]:
        """Return all edits, oldest first."""
        ...

    def save_edits(self, edits: tuple[Edit, ...]) -> None:
        """Replace the edits, durably."""
        ...

    def areas(self, agent_id: str = "") -> tuple[Area, ...]:
        """Return the named areas; agent_id: in the frame of this agent's map."""
        ...

    def save_areas(self, areas: tuple[Area, ...]) -> None:
        """Replace the areas, durably."""
        ...

    def objects(self) -> EditedObjects:
        """Return the objects after all edits, and what people said of them."""
        ...


FindPlace = Callable[[str], ServedPlace]
"""Returns the place of a mission. Raises MismatchError for another mission."""


def memory_service(engine: FindEngine) -> Service:
    """Return the service of a fusion server."""
    return service_of(lambda mission_id: TeamPlace(engine(), mission_id))


def service_of(place: FindPlace) -> Service:
    """Return the service of a place."""
    register = functools.partial(pb_grpc.add_MemoryServiceServicer_to_server, MemoryServicer(place))
    return Service("gausslite.v1.MemoryService", register)


class MemoryServicer(pb_grpc.MemoryServiceServicer):
    """Edits objects as the caller; the work runs in a thread, in fair turns between the callers."""

    def __init__(self, place: FindPlace) -> None:
        self._place = place
        # one thread: an edit follows the edits before it
        self._work = WorkerPool("memory")

    async def EditObject(self, request: pb.EditObjectRequest, context: Any) -> pb.EditObjectResponse:
        """Correct an object."""
        caller = Caller.of(context)
        author = (request.author or caller.host) if caller.names is None else caller.key
        entry = await self._work.run(context, self._edit, request, author)
        _log.info("objects: %s", entry.describe())
        return pb.EditObjectResponse(edit=entry_to_message(entry))

    async def SetArea(self, request: pb.SetAreaRequest, context: Any) -> pb.SetAreaResponse:
        """Add, replace or remove an area."""
        await self._work.run(context, self._set_area, request)
        return pb.SetAreaResponse()

    async def GetMemory(self, request: pb.GetMemoryRequest, context: Any) -> pb.GetMemoryResponse:
        """Return edits, areas, and what people said of each object."""
        return await self._work.run(context, self._read, request)

    def _edit(self, request: pb.EditObjectRequest, author: str) -> EditEntry:
        place, kind = self._place(request.mission_id), kind_from_number(request.kind)
        edits = place.edits()
        made = new_edit(edits, place.objects().objects, kind, request.object_id, request.value, author)
        place.save_edits((*edits, made))
        return EditEntry.of(len(edits) + 1, made)

    def _set_area(self, request: pb.SetAreaRequest) -> None:
        place, area = self._place(request.mission_id), request.area
        areas = place.areas()
        changed = with_area(areas, area_from_message(area)) if area.corners_m else without_area(areas, area.name)
        place.save_areas(changed)

    def _read(self, request: pb.GetMemoryRequest) -> pb.GetMemoryResponse:
        place = self._place(request.mission_id)
        if request.agent_id:
            return pb.GetMemoryResponse(areas=map(area_to_message, place.areas(request.agent_id)))
        edited = place.objects()
        return pb.GetMemoryResponse(
            edits=[entry_to_message(EditEntry.of(number, edit)) for number, edit in enumerate(place.edits(), 1)],
            areas=map(area_to_message, place.areas()),
            remarks=[
                pb.ObjectRemarks(object_id=name, is_pinned=name in edited.pinned, notes=edited.notes.get(name, ()))
                for name in sorted(edited.pinned | edited.notes.keys())
            ],
        )


class TeamPlace:
    """The ServedPlace of a fusion server's mission: records of its store."""

    def __init__(self, engine: FusionEngine, mission_id: str) -> None:
        """Raises MismatchError for another mission than the engine's."""
        engine.members.require_mission(mission_id)
        self._engine = engine

    def edits(self) -> tuple[Edit, ...]:
        """Return all edits, oldest first. Raises CodecError."""
        return decode_edits(self._engine.store.find_record(_NOBODY, EDITS_RECORD))

    def save_edits(self, edits: tuple[Edit, ...]) -> None:
        """Replace the edits. Raises StorageError."""
        self._engine.store.save_record(_NOBODY, EDITS_RECORD, encode_edits(edits))

    def areas(self, agent_id: str = "") -> tuple[Area, ...]:
        """Return the named areas; none to an agent whose map is not used. Raises CodecError, InvalidInputError."""
        frames, areas = self._engine.frames, decode_areas(self._engine.store.find_record(_NOBODY, _AREAS_RECORD))
        if not agent_id:
            return areas
        T_agent_fused = inverse(frames.get(agent_id).T_fused_agent)
        return () if agent_id in frames.unused else tuple(area.moved(T_agent_fused) for area in areas)

    def save_areas(self, areas: tuple[Area, ...]) -> None:
        """Replace the areas. Raises StorageError."""
        self._engine.store.save_record(_NOBODY, _AREAS_RECORD, encode_areas(areas))

    def objects(self) -> EditedObjects:
        """Return the team's objects after all edits; without remarks if another package merges them."""
        objects, merged = self._engine.query_objects(), self._engine.merged_objects
        if isinstance(merged, MergedObjects):
            return merged.edited
        return apply_edits([found.landmark for found in objects], ())
