"""The methods of RegionService: what other servers ask of the part of the mission that this one owns."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from gausslite.codec.body import SubsetCoding
from gausslite.codec.encoded_voxels import EncodedSubset, EncodedVoxels
from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import CodecError, InvalidInputError, UnavailableError
from gausslite.domain.voxels import RoiSubset, VoxelGrid
from gausslite.fusion.limits import SessionRecord
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import region_service_pb2 as region_pb
from gausslite.v1 import region_service_pb2_grpc as region_pb_grpc
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite.wire.map_changes import BLOCK_BYTES, read_deadline
from gausslite.wire.server import Service
from gausslite_cluster.region_host import RegionHost
from gausslite_fusion_server.contributions import StoredCount
from gausslite_fusion_server.messages import select_map
from gausslite_fusion_server.servicer import FusionServicer

# ruff: noqa: N802, ARG002 - the methods' names and arguments are those of the generated base class

SLOTS_KEY = "gausslite-slots"
"""The initial metadata of an answer: the slots for which it holds, as bits of a hexadecimal number."""
_SENDER = "fusion-server"
_log = logging.getLogger(__name__)


AT_HOME = {
    method.name: method
    for method in pb.DESCRIPTOR.services_by_name["FusionService"].methods
    if not method.server_streaming
}
"""The methods of FusionService that an agent's home answers."""


async def _stream_of(request: Message) -> AsyncIterator[Message]:
    yield request


class RegionServicer(region_pb_grpc.RegionServiceServicer):
    """Answers for the host's engine as it is at the call. Parts of messages are counted in `stored` and `foreign`."""

    def __init__(self, host: RegionHost) -> None:
        self._host = host
        self.stored = self.foreign = 0

    def service(self) -> Service:
        """Return the servicer, ready for a server."""
        return Service("gausslite.v1.RegionService", partial(region_pb_grpc.add_RegionServiceServicer_to_server, self))

    async def store_part(self, session_id: str, part: EncodedSubset) -> StoredCount:
        """Store a part of a message. Raises GaussLiteError."""
        try:
            if not self._host.owned.have(part.voxels.keys):
                self.foreign += 1
                raise UnavailableError(f"server {self._host.server}: does not own all of these voxels")
            count = await self._host.local().store_message(SessionRecord(session_id, part.agent_id), part)
        except RuntimeError as error:
            # the threads of an engine that has just been closed
            raise UnavailableError(f"server {self._host.server}: its regions change") from error
        self.stored += 1
        return count

    async def StorePart(self, request: region_pb.StorePartRequest, context: Any) -> region_pb.StorePartResponse:
        """Store a part of a message."""
        voxels = EncodedVoxels.from_row(request.voxels)
        _require_codes_of(self._host.settings.grid, voxels)
        part = EncodedSubset(request.agent_id, request.message_seq, request.update_seq, voxels)
        count = await self.store_part(request.session_id, part)
        return region_pb.StorePartResponse(accepted_voxels=count.accepted, stale_voxels=count.stale)

    async def BeginAgent(self, request: region_pb.BeginAgentRequest, context: Any) -> region_pb.BeginAgentResponse:
        """Note that an agent has joined at its home."""
        fresh_map = request.fresh_map and request.home != self._host.server
        if fresh_map and self._host.owned.is_home(request.agent_id):
            raise UnavailableError(f"server {self._host.server}: has become the home of this agent; join again")
        engine = (await self._local(context)).engine
        highest = await asyncio.to_thread(engine.begin_elsewhere, request.agent_id, fresh_map)
        return region_pb.BeginAgentResponse(highest_update_seq=highest)

    async def RemoveAgent(self, request: region_pb.RemoveAgentRequest, context: Any) -> region_pb.RemoveAgentResponse:
        """Delete an agent's voxels here."""
        local = await self._local(context)
        voxels = await asyncio.to_thread(local.engine.remove_elsewhere, request.agent_id)
        local.publish_changes()
        return region_pb.RemoveAgentResponse(voxels=voxels)

    async def ReadVoxels(
        self, request: pb.ExportFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """Send the voxels of a map that are owned here, without loss."""
        engine = (await self._local(context)).engine
        batch = await asyncio.to_thread(select_map, engine, request)
        for part in split_batch(batch, BLOCK_BYTES, SubsetCoding.LOSSLESS):
            subset = RoiSubset(_SENDER, "", 0, 0, part)
            data = await asyncio.to_thread(encode_subset, subset, engine.grid, SubsetCoding.LOSSLESS)
            with read_deadline():
                yield pb.WatchFusedMapResponse(block=MapBlock(subset=data))

    async def WatchFusedMap(
        self, request: pb.WatchFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """Send the part of the map that is owned here, then its changes."""
        local = await self._local(context)
        async for response in local.WatchFusedMap(request, context):
            yield response

    async def GetSessionStatus(self, request: pb.GetSessionStatusRequest, context: Any) -> pb.GetSessionStatusResponse:
        """Return the figures of the part of the mission that is owned here."""
        local = await self._local(context)
        return await local.GetSessionStatus(request, context)

    async def GetUpdateDigests(
        self, request: pb.GetUpdateDigestsRequest, context: Any
    ) -> AsyncIterator[pb.GetUpdateDigestsResponse]:
        """Return the digests of an agent's updates that are owned here."""
        local = await self._local(context)
        async for response in local.GetUpdateDigests(request, context):
            yield response

    async def CallHome(self, request: region_pb.CallHomeRequest, context: Any) -> region_pb.CallHomeResponse:
        """Call a method for an agent whose home this server is."""
        if request.method not in AT_HOME:
            raise InvalidInputError(f"method: expected one of {', '.join(AT_HOME)}, got {quote_name(request.method)}")
        own = GetMessageClass(AT_HOME[request.method].input_type).FromString(request.request)
        response = await self.call_home(request.agent_id, request.method, own, context)
        return region_pb.CallHomeResponse(response=response.SerializeToString())

    async def call_home(self, agent_id: str, method: str, request: Message, context: Any) -> Message:
        """Return the answer of the own servicer. Raises UnavailableError if this is not the agent's home."""
        if not self._host.owned.is_home(agent_id):
            raise UnavailableError(f"server {self._host.server}: is not the home of this agent")
        argument = _stream_of(request) if AT_HOME[method].client_streaming else request
        response: Message = await getattr(self._host.local(), method)(argument, context)
        return response

    async def _local(self, context: Any) -> FusionServicer:
        """Return what serves the own part, after a statement of the slots for which its answer holds."""
        local, slots = self._host.local(), sum(1 << slot for slot in self._host.owned.slots)
        await context.send_initial_metadata(((SLOTS_KEY, f"{slots:x}"),))
        return local


def _require_codes_of(grid: VoxelGrid, voxels: EncodedVoxels) -> None:
    """Raise CodecError for a row that no server of this mission sends: once stored, it could not be read."""
    keys = voxels.keys
    if voxels.size_m not in (0.0, grid.size_m) or (keys[:1] < 0).any() or (keys[1:] <= keys[:-1]).any():
        raise CodecError(f"part: expected ascending voxels of {grid.size_m:g} m, got others")
