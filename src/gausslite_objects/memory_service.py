"""The methods of MemoryService: edits and areas of a fusion server's mission, kept in its store.

`memory_service` is a plug-in of the group `gausslite.server_services`.
"""

from __future__ import annotations

import functools
import logging
from typing import Any

from gausslite.fusion.engine import FusionEngine
from gausslite.v1 import memory_service_pb2 as pb
from gausslite.v1 import memory_service_pb2_grpc as pb_grpc
from gausslite.wire.security import Caller
from gausslite.wire.server import Service
from gausslite.wire.worker_pool import WorkerPool
from gausslite_fusion_server.plugins import FindEngine
from gausslite_objects.areas import Area, decode_areas, encode_areas, with_area, without_area
from gausslite_objects.edits import decode_edits, encode_edits
from gausslite_objects.memory_client import area_from_message, area_to_message, entry_to_message, kind_from_number
from gausslite_objects.object_memory import EditEntry, new_edit
from gausslite_objects.team_objects import EDITS_RECORD, MergedObjects

# ruff: noqa: N802 - the methods' names are those of the generated base class

_AREAS_RECORD = "areas"
_NOBODY = ""
"""The mission's own records belong to no agent."""
_log = logging.getLogger(__name__)


def memory_service(engine: FindEngine) -> Service:
    """Return the service of a server."""
    register = functools.partial(pb_grpc.add_MemoryServiceServicer_to_server, MemoryServicer(engine))
    return Service("gausslite.v1.MemoryService", register)


class MemoryServicer(pb_grpc.MemoryServiceServicer):
    """Edits objects as the caller; the work runs in a thread, in fair turns between the callers."""

    def __init__(self, engine: FindEngine) -> None:
        self._engine = engine
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
        engine, kind = self._engine_of(request.mission_id), kind_from_number(request.kind)
        edits = decode_edits(engine.store.find_record(_NOBODY, EDITS_RECORD))
        objects = [found.landmark for found in engine.query_objects()]
        made = new_edit(edits, objects, kind, request.object_id, request.value, author)
        engine.store.save_record(_NOBODY, EDITS_RECORD, encode_edits((*edits, made)))
        return EditEntry.of(len(edits) + 1, made)

    def _set_area(self, request: pb.SetAreaRequest) -> None:
        engine, area = self._engine_of(request.mission_id), request.area
        areas = _areas(engine)
        areas = with_area(areas, area_from_message(area)) if area.corners_m else without_area(areas, area.name)
        engine.store.save_record(_NOBODY, _AREAS_RECORD, encode_areas(areas))

    def _read(self, request: pb.GetMemoryRequest) -> pb.GetMemoryResponse:
        engine = self._engine_of(request.mission_id)
        edits = decode_edits(engine.store.find_record(_NOBODY, EDITS_RECORD))
        remarks = []
        if isinstance(engine.merged_objects, MergedObjects):
            engine.query_objects()
            edited = engine.merged_objects.edited
            remarks = [
                pb.ObjectRemarks(object_id=name, is_pinned=name in edited.pinned, notes=edited.notes.get(name, ()))
                for name in sorted(edited.pinned | edited.notes.keys())
            ]
        return pb.GetMemoryResponse(
            edits=[entry_to_message(EditEntry.of(number, edit)) for number, edit in enumerate(edits, 1)],
            areas=map(area_to_message, _areas(engine)),
            remarks=remarks,
        )

    def _engine_of(self, mission_id: str) -> FusionEngine:
        engine = self._engine()
        engine.members.require_mission(mission_id)
        return engine


def _areas(engine: FusionEngine) -> tuple[Area, ...]:
    return decode_areas(engine.store.find_record(_NOBODY, _AREAS_RECORD))
