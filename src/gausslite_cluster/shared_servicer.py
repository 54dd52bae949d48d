"""Serve a mission together with other servers: route each call to who owns what it needs."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import AsyncIterator, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from google.protobuf.message_factory import GetMessageClass

from gausslite.codec.subset_codec import CodecLimits, decode_subset
from gausslite.domain.errors import GaussLiteError, InvalidInputError, MismatchError, UnavailableError
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import VoxelBatch, merge_batches
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import SessionRecord
from gausslite.fusion.traffic import Acknowledgements
from gausslite.render.choose import choose_rasterizer
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.v1 import region_service_pb2 as region_pb
from gausslite.wire.call_limits import RejectionLog
from gausslite.wire.channel import MAX_MESSAGE_BYTES
from gausslite.wire.convert import digests_from_messages, digests_to_messages
from gausslite.wire.map_changes import read_deadline
from gausslite.wire.security import Caller
from gausslite.wire.server import Service
from gausslite_cluster.peers import READ_S, PartSender, Peers
from gausslite_cluster.postgres_regions import SharedSlots
from gausslite_cluster.region_host import RegionHost
from gausslite_cluster.region_servicer import AT_HOME, RegionServicer
from gausslite_cluster.regions import Owners
from gausslite_cluster.shared_watch import SharedRevisions, SharedWatch
from gausslite_fusion_server.contributions import Acknowledger
from gausslite_fusion_server.messages import ExportedFile, declared_frame_from_message
from gausslite_fusion_server.plugins import MessageCounts
from gausslite_fusion_server.servicer import MAX_REPORTED_REJECTIONS, DrainGate, FusionServicer
from gausslite_fusion_server.settings import ServerSettings
from gausslite_fusion_server.watch import watch_filter

# ruff: noqa: N802, ARG002 - the methods' names and arguments are those of the generated base class

_log = logging.getLogger(__name__)
_PART_LIMITS = CodecLimits(max_bytes=MAX_MESSAGE_BYTES, max_voxels=2_000_000, max_gaussians=2_000_000)


class SharedServicer(pb_grpc.FusionServiceServicer):
    """Accepts any agent and any watcher. What needs voxels goes to their owners, what needs an agent to its home."""

    def __init__(self, host: RegionHost, regions: RegionServicer, peers: Peers, sender: PartSender) -> None:
        self._host, self._regions, self._peers, self._sender = host, regions, peers, sender
        self._gate = DrainGate()
        self._watch = SharedWatch(host, peers, SharedRevisions(), host.settings.grid)
        self._rejections = RejectionLog(_log)
        self._exports = asyncio.Lock()

    def service(self) -> Service:
        """Return the servicer, ready for a server."""
        return Service(
            "gausslite.v1.FusionService",
            functools.partial(pb_grpc.add_FusionServiceServicer_to_server, self),
            self._host.check,
            self._sender.acknowledgements.check,
        )

    def drain(self) -> None:
        """End every open stream of agents and every later call with UNAVAILABLE."""
        self._gate.close()
        self._host.changes.notify()

    async def JoinSession(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        """Join at the agent's home, and tell the other owners."""
        Caller.of(context).require_agent(request.agent_id)
        T_fused_agent = declared_frame_from_message(request)
        if request.frame_is_unknown or (T_fused_agent is not None and not np.array_equal(T_fused_agent, np.eye(4))):
            raise MismatchError(
                "frame: expected the mission's, because several servers share this mission and use maps as they are "
                "sent; localise the robot in the mission's frame"
            )
        response: pb.JoinSessionResponse = await self._at_home(request.agent_id, "JoinSession", request, context)
        begin = region_pb.BeginAgentRequest(
            agent_id=request.agent_id, fresh_map=request.fresh_map, home=self._home(request.agent_id)
        )
        response.highest_update_seq = max(response.highest_update_seq, await self._begin(begin))
        return response

    async def _begin(self, begin: region_pb.BeginAgentRequest) -> int:
        """Tell all owners that an agent has joined; returns its highest update_seq."""
        answers = await self._peers.call_all(self._host.owners.servers, "BeginAgent", begin)
        return max(int(answer.highest_update_seq) for answer in answers.values())

    async def KeepSession(self, request: pb.KeepSessionRequest, context: Any) -> pb.KeepSessionResponse:
        """Renew the agent's lease; return what identifies the stored updates."""
        session = await self._session(request.session_id, Caller.of(context))
        response: pb.KeepSessionResponse = await self._at_home(session.agent_id, "KeepSession", request, context)
        highest = self._sender.highest_acknowledged(session)
        if highest is None:
            highest = await self._begin(region_pb.BeginAgentRequest(agent_id=session.agent_id))
            self._sender.note_acknowledged(session, highest)
        response.highest_update_seq = max(response.highest_update_seq, highest)
        return response

    async def GetUpdateDigests(
        self, request: pb.GetUpdateDigestsRequest, context: Any
    ) -> AsyncIterator[pb.GetUpdateDigestsResponse]:
        """Return the digests of the agent's stored updates."""
        await self._session(request.session_id, Caller.of(context))
        answers = await self._peers.call_all(self._host.owners.servers, "GetUpdateDigests", request, READ_S)
        digests = TileDigests.sum_of(digests_from_messages(blocks) for blocks in answers.values())
        for block in digests_to_messages(digests):
            with read_deadline():
                yield block

    async def ContributeSubsets(
        self, request_iterator: AsyncIterator[pb.ContributeSubsetsRequest], context: Any
    ) -> AsyncIterator[pb.ContributeSubsetsResponse]:
        """Store voxel updates; one acknowledgement for each message, after all owners have their parts."""
        caller, session = Caller.of(context), None
        stream = Acknowledger(caller, self._host.traffic, self._rejections)
        async for request in self._gate.admit(request_iterator):
            if session is None or session.session_id != request.session_id:
                session = await self._session(request.session_id, caller)
            try:
                stored = await self._sender.store(session, request.subset)
                answer = stream.accept(request, session.agent_id, stored)
            except GaussLiteError as error:
                answer = stream.refuse(request, session.agent_id, error)
            yield answer

    async def ContributeKeyframes(
        self, request_iterator: AsyncIterator[pb.ContributeKeyframesRequest], context: Any
    ) -> pb.ContributeKeyframesResponse:
        """Store keyframes at the agent's home."""
        total, caller = pb.ContributeKeyframesResponse(), Caller.of(context)
        async for request in self._gate.admit(request_iterator):
            session = await self._session(request.session_id, caller)
            response = await self._at_home(session.agent_id, "ContributeKeyframes", request, context)
            total.accepted += response.accepted
            total.rejected.extend(response.rejected)
            if len(total.rejected) > MAX_REPORTED_REJECTIONS:
                raise InvalidInputError(total.rejected[-1].reason)
        return total

    async def GetKeyframe(self, request: pb.GetKeyframeRequest, context: Any) -> pb.GetKeyframeResponse:
        """Return a stored keyframe of an agent, for a person."""
        response: pb.GetKeyframeResponse = await self._at_home(request.agent_id, "GetKeyframe", request, context)
        return response

    async def WatchFusedMap(
        self, request: pb.WatchFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """Send the map, then its changes, from the owners of what is looked at."""
        await self._require_mission(request.mission_id)
        region = watch_filter(request).region
        async for response in self._watch.follow(request, region, self._gate.require_open):
            yield response

    async def RefineFusedMap(
        self, request: pb.RefineFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.RefineFusedMapResponse]:
        """Refuse: a refinement needs the whole map in one server."""
        _refuse("refinement")
        yield pb.RefineFusedMapResponse()

    async def ExportFusedMap(
        self, request: pb.ExportFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.ExportFusedMapResponse]:
        """Send a map, put together from all owners, as the bytes of a PLY file."""
        await self._require_mission(request.mission_id)

        async with self._exports:
            batch = await self._read_map(request)
            world_frame = (await self._host.ready()).engine.members.mission_config.given_world_frame
            exported = await asyncio.to_thread(ExportedFile, batch, world_frame)
            del batch
        async for chunk in exported.chunks():
            self._gate.require_open()
            yield chunk

    async def RenderView(self, request: pb.RenderFusedViewRequest, context: Any) -> pb.RenderFusedViewResponse:
        """Refuse: a view needs the whole map in one server."""
        _refuse("view")
        return pb.RenderFusedViewResponse()

    async def ReportObjects(self, request: pb.ReportObjectsRequest, context: Any) -> pb.ReportObjectsResponse:
        """Replace the agent's task graph and objects; every server reads them in the store."""
        await self._session(request.session_id, Caller.of(context))
        return await (await self._host.ready()).ReportObjects(request, context)

    async def QueryObjects(self, request: pb.QueryObjectsRequest, context: Any) -> pb.QueryObjectsResponse:
        """Return the team's objects that a noun names, or all, of the reports as they are stored now."""
        self._gate.require_open()
        return await (await self._host.ready()).QueryObjects(request, context)

    async def GetSessionStatus(self, request: pb.GetSessionStatusRequest, context: Any) -> pb.GetSessionStatusResponse:
        """Return the figures of the mission and of each agent, summed over the owners."""
        await self._require_mission(request.mission_id)
        owners = self._host.owners
        parts = await self._peers.call_all(owners.servers, "GetSessionStatus", request)
        return sum_status(parts, owners)

    async def LeaveSession(self, request: pb.LeaveSessionRequest, context: Any) -> pb.LeaveSessionResponse:
        """End a session; with `forget` the agent's updates are deleted."""
        session = await self._session(request.session_id, Caller.of(context))
        response: pb.LeaveSessionResponse = await self._at_home(session.agent_id, "LeaveSession", request, context)
        if request.forget:
            await self._remove_elsewhere(session.agent_id)
        return response

    async def EvictAgent(self, request: pb.EvictAgentRequest, context: Any) -> pb.EvictAgentResponse:
        """End an agent's session and delete its data; with `ban` its later joins are refused."""
        await self._require_mission(request.mission_id)
        unknown: GaussLiteError | None = None
        try:
            response = await self._at_home(request.agent_id, "EvictAgent", request, context)
        except InvalidInputError as error:
            # its home may have none of its voxels
            response, unknown = pb.EvictAgentResponse(), error
        response.voxels += await self._remove_elsewhere(request.agent_id)
        if unknown is not None and not response.voxels:
            raise unknown
        evicted: pb.EvictAgentResponse = response
        return evicted

    async def UnbanAgent(self, request: pb.UnbanAgentRequest, context: Any) -> pb.UnbanAgentResponse:
        """Let a banned agent join again."""
        response: pb.UnbanAgentResponse = await self._at_home(request.agent_id, "UnbanAgent", request, context)
        return response

    async def _remove_elsewhere(self, agent_id: str) -> int:
        """Delete the agent's voxels at all owners; returns the number of those that its home had not deleted."""
        request = region_pb.RemoveAgentRequest(agent_id=agent_id)
        answers = await self._peers.call_all(self._host.owners.servers, "RemoveAgent", request)
        return sum(answer.voxels for answer in answers.values())

    async def _session(self, session_id: str, caller: Caller) -> SessionRecord:
        """Return a session, whoever opened it. Raises SessionUnknownError, NotPermittedError for another robot."""
        sessions = (await self._host.ready()).engine.members.sessions
        session = sessions.known(session_id)
        if session is None:
            session = await asyncio.to_thread(sessions.get, session_id)
        caller.require_agent(session.agent_id)
        return session

    async def _require_mission(self, mission_id: str) -> None:
        self._gate.require_open()
        (await self._host.ready()).engine.members.require_mission(mission_id)

    def _home(self, agent_id: str) -> str:
        server = self._host.owners.home(agent_id)
        if server is None:
            raise UnavailableError("fusion server: nobody is the home of this agent now; try again in a moment")
        return server

    async def _at_home(self, agent_id: str, method: str, request: Any, context: Any) -> Any:
        """Return the answer of the agent's home. Raises GaussLiteError."""
        self._gate.require_open()
        server = await self._host.wait_for(functools.partial(self._home, agent_id))
        if server == self._host.server:
            await self._host.ready()
            return await self._regions.call_home(agent_id, method, request, context)
        call = region_pb.CallHomeRequest(agent_id=agent_id, method=method, request=request.SerializeToString())
        try:
            answer = await self._peers.call(server, "CallHome", call)
        except UnavailableError:
            self._host.wake()
            raise
        return GetMessageClass(AT_HOME[method].output_type).FromString(answer.response)

    async def _read_map(self, request: pb.ExportFusedMapRequest) -> VoxelBatch:
        if request.strategy == pb.FUSION_STRATEGY_REFINED:
            _refuse("refined map")
        answers = await self._peers.call_all(self._host.owners.servers, "ReadVoxels", request, READ_S)
        return await asyncio.to_thread(_merge, [block.block.subset for own in answers.values() for block in own])


def _refuse(what: str) -> None:
    raise MismatchError(
        f"{what}: expected one server with the whole map, but several share this mission; export it, or run one server "
        "without peer-address"
    )


def _merge(parts: Iterable[bytes]) -> VoxelBatch:
    return merge_batches(*(decode_subset(data, _PART_LIMITS)[0].batch for data in parts))


def sum_status(parts: Mapping[str, pb.GetSessionStatusResponse], owners: Owners) -> pb.GetSessionStatusResponse:
    """Return the figures of a mission from those of each server's part; what an agent's home knows is taken from it."""
    total = pb.GetSessionStatusResponse()
    agents: dict[str, pb.AgentContribution] = {}
    for server, part in parts.items():
        if not total.mission_id:
            total.mission_id, total.world_frame = part.mission_id, part.world_frame
            total.grid.CopyFrom(part.grid)
        total.fused_revision = max(total.fused_revision, part.fused_revision)
        total.fused_gaussians += part.fused_gaussians
        total.fused_voxels += part.fused_voxels
        total.banned_agents.extend(name for name in part.banned_agents if owners.home(name) == server)
        for own in part.agents:
            _add(agents.setdefault(own.agent_id, pb.AgentContribution(agent_id=own.agent_id)), own)
            if owners.home(own.agent_id) == server:
                agent = agents[own.agent_id]
                agent.joined, agent.keyframes = own.joined, own.keyframes
                agent.localisation = own.localisation
                agent.targets[:] = own.targets
                agent.alignment.CopyFrom(own.alignment)
    total.agents.extend(agents[name] for name in sorted(agents))
    total.keyframes = sum(agent.keyframes for agent in total.agents)
    return total


_SUMS = (
    *("gaussians", "voxels", "won_voxels", "roi_bytes", "handover_bytes", "kappa_sum"),
    *("subsets_accepted", "subsets_stale", "subsets_rejected"),
)


def _add(agent: pb.AgentContribution, part: pb.AgentContribution) -> None:
    for name in _SUMS:
        setattr(agent, name, getattr(agent, name) + getattr(part, name))
    for name in ("last_update_seq", "last_seen_ns"):
        setattr(agent, name, max(getattr(agent, name), getattr(part, name)))


@dataclass(frozen=True, slots=True)
class Share:
    """One of the servers of a mission: what it serves, and what it has to run meanwhile."""

    host: RegionHost
    regions: RegionServicer
    sender: PartSender
    servicer: SharedServicer

    @property
    def acknowledgements(self) -> Acknowledgements:
        """Of the messages that agents have sent to this server."""
        return self.sender.acknowledgements

    @property
    def services(self) -> list[Service]:
        """The service for agents and watchers, and the one for the other servers."""
        return [self.servicer.service(), self.regions.service()]

    async def run(self) -> None:
        """Take part until it is cancelled; then end the open streams, and leave the regions to the other servers."""
        try:
            await self.host.run()
        finally:
            self.servicer.drain()
            await self.host.close()

    def engine(self) -> FusionEngine:
        """Return the engine of the part that this server owns. Raises UnavailableError while it is opened."""
        return self.host.local().engine

    def counts(self) -> MessageCounts:
        """Return how much of the mission's work this server has done."""
        return MessageCounts(self.sender.received, self.sender.sent, self.regions.stored, self.regions.foreign)


@asynccontextmanager
async def open_share(settings: ServerSettings, url: str, peer_address: str) -> AsyncIterator[Share]:
    """Take part in a mission while the context is open. Raises InvalidInputError, StorageError."""
    slots = await asyncio.to_thread(SharedSlots, url, peer_address)
    _log.info("server %s: shares its mission; frames of agents are used as they are (trust)", peer_address)

    def create_servicer(engine: FusionEngine) -> FusionServicer:
        return FusionServicer(engine, settings.refine, partial(choose_rasterizer, settings.rasterizer))

    # names are fixed, and frames are trusted
    agreed = settings.fusion.mission_config.with_default_names()
    fusion = replace(settings.fusion, mission_id=agreed.mission_id, world_frame=agreed.world_frame)
    host, peers = RegionHost(slots, fusion, create_servicer), Peers(settings.tls)
    regions = RegionServicer(host)
    sender = PartSender(host, regions, peers, fusion.grid)
    try:
        yield Share(host, regions, sender, SharedServicer(host, regions, peers, sender))
    finally:
        await host.close()
        await asyncio.to_thread(sender.close)
        await peers.close()
