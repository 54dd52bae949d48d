"""The rpcs of the fusion service: each one decodes, calls the team's map and encodes."""
# ruff: noqa: N802, ARG002 - the methods' names and arguments are those of the generated base class

from __future__ import annotations

import asyncio
import functools
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import google_crc32c

from gausslite.codec.ply import ply_bytes
from gausslite.codec.subset_codec import MAX_SUBSET_BYTES, decode_subset
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    QuotaError,
    RevisionGoneError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.fusion.engine import Changes, FusionEngine
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.fusion.store import MissionConfig
from gausslite.fusion.traffic import AgentContribution, TrafficCounters
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite.wire.change_notifier import ChangeNotifier
from gausslite.wire.convert import box_from_message, frame_from_message, grid_from_message, grid_to_message
from gausslite.wire.server import Service
from gausslite.wire.status import code_and_reason
from gausslite.wire.tls import require_agent_certificate
from gausslite_fusion_server.change_blocks import change_blocks
from gausslite_fusion_server.drain_gate import DrainGate
from gausslite_fusion_server.refinement_worker import RefinementWorker, RefineRequest

_CHUNK_BYTES = 1 << 20
_MAX_REPORTED_REJECTIONS = 1000
_WORKERS = 4
_ENDS_THE_STREAM = (SessionUnknownError, MismatchError, StorageError, UnavailableError)
"""Errors that every further block would meet too; after any other one the next block may be fine."""

_Result = TypeVar("_Result")
_ACCEPTED, _STALE, _REJECTED = (
    pb.SUBSET_STATUS_ACCEPTED,
    pb.SUBSET_STATUS_STALE,
    pb.SUBSET_STATUS_REJECTED,
)


class FusionServicer(pb_grpc.FusionServiceServicer):
    """Serves one team's map. All work runs in threads, so that the event loop answers health checks at any time."""

    def __init__(self, team: FusionEngine, refinery: RefinementWorker) -> None:
        self._team = team
        self._refinery = refinery
        self._workers = ThreadPoolExecutor(_WORKERS, "fusion")
        self._news = ChangeNotifier()
        self._door = DrainGate()

    def service(self) -> Service:
        """The servicer, ready for a server."""
        return Service(
            pb.DESCRIPTOR.services_by_name["FusionService"].full_name,
            functools.partial(pb_grpc.add_FusionServiceServicer_to_server, self),
        )

    def drain(self) -> None:
        """From now on every call, and every open stream, ends with UNAVAILABLE."""
        self._door.shut()
        self._news.notify()

    def close(self) -> None:
        """Let work in threads come to its end."""
        self._workers.shutdown(wait=True)
        self._refinery.close()

    async def JoinSession(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        """Enter the mission."""
        require_agent_certificate(context, request.agent_id)
        grid = grid_from_message(request.grid)
        asked = MissionConfig(request.mission_id, request.world_frame, grid.size_m)
        joined = await self._work(self._team.join, request.agent_id, asked, request.fresh_map)
        self._news.notify()
        return pb.JoinSessionResponse(
            session_id=joined.session.session_id,
            highest_map_revision=joined.highest_map_revision,
            fused_revision=joined.revision,
            grid=grid_to_message(self._team.grid),
            max_subset_bytes=MAX_SUBSET_BYTES,
            max_gaussians=self._team.settings.quotas.gaussians_per_agent,
        )

    async def ContributeSubsets(
        self, request_iterator: AsyncIterator[pb.ContributeSubsetsRequest], context: Any
    ) -> AsyncIterator[pb.ContributeSubsetsResponse]:
        """Words in, one acknowledgement for each."""
        acknowledged = 0
        async for request in self._door.admit(request_iterator):
            outcome = await self._work(self._take_in, request)
            self._news.notify()
            acknowledged = max(acknowledged, request.sequence)
            yield pb.ContributeSubsetsResponse(acknowledged=acknowledged, outcomes=[outcome])

    async def ContributeKeyframes(
        self, request_iterator: AsyncIterator[pb.ContributeKeyframesRequest], context: Any
    ) -> pb.ContributeKeyframesResponse:
        """Views for the refinement; an unusable one is reported and the rest is kept."""
        response = pb.ContributeKeyframesResponse()
        async for request in self._door.admit(request_iterator):
            try:
                await self._work(self._take_view, request)
                response.accepted += 1
            except (InvalidInputError, QuotaError) as error:
                if len(response.rejected) >= _MAX_REPORTED_REJECTIONS:
                    raise
                response.rejected.add(index=request.keyframe.index, reason=str(error))
        return response

    async def WatchFusedMap(
        self, request: pb.WatchFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """The map, then its changes. A watcher that reads slowly finds the changes since summed up, never queued."""
        self._team.require_mission(request.mission_id)
        region = box_from_message(request.region) if request.HasField("region") else None
        changes = await self._work(self._team.changes, request.since_revision)
        while True:
            blocks = change_blocks(changes, self._team.grid, region)
            while (block := await self._work(_next_block, blocks)) is not None:
                yield pb.WatchFusedMapResponse(block=block)
            ticket = self._news.subscribe()
            while self._team.revision == changes.revision and self._door.is_open:
                await ticket.wait()
                ticket = self._news.subscribe()
            changes = await self._work(self._catch_up, changes.revision)

    async def RefineFusedMap(
        self, request: pb.RefineFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.RefineFusedMapResponse]:
        """Joint optimisation, with its progress; closing the stream cancels it."""
        self._door.require_open()
        self._team.require_mission(request.mission_id)
        order = RefineRequest(request.iterations, request.max_gaussians, request.seed)
        response = pb.RefineFusedMapResponse()
        async for progress in self._refinery.run(self._team, order):
            self._door.require_open()
            response = pb.RefineFusedMapResponse(
                iteration=progress.iteration,
                iterations=progress.iterations,
                loss=progress.loss,
                gaussians=progress.gaussians,
            )
            yield response
        response.done = True
        yield response

    async def ExportFusedMap(
        self, request: pb.ExportFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.ExportFusedMapResponse]:
        """A map as the bytes of a PLY file."""
        self._team.require_mission(request.mission_id)
        data, crc32c = await self._work(self._export, request)
        for offset in range(0, len(data), _CHUNK_BYTES):
            self._door.require_open()
            chunk = data[offset : offset + _CHUNK_BYTES]
            yield pb.ExportFusedMapResponse(offset=offset, total_bytes=len(data), data=chunk, crc32c=crc32c)

    async def GetSessionStatus(self, request: pb.GetSessionStatusRequest, context: Any) -> pb.GetSessionStatusResponse:
        """The mission and each agent's part in figures."""
        self._team.require_mission(request.mission_id)
        status = await self._work(self._team.status)
        return pb.GetSessionStatusResponse(
            mission_id=status.mission_config.mission_id,
            grid=grid_to_message(self._team.grid),
            world_frame=status.mission_config.world_frame,
            fused_revision=status.revision,
            fused_gaussians=status.fused_gaussians,
            fused_voxels=status.fused_voxels,
            agents=[_contribution_to_message(agent) for agent in status.agents],
            keyframes=status.keyframes,
            refined=status.refined,
        )

    async def LeaveSession(self, request: pb.LeaveSessionRequest, context: Any) -> pb.LeaveSessionResponse:
        """End a session, and forget what the agent said when it asks for that."""
        revision = await self._work(self._team.leave, request.session_id, request.forget)
        self._news.notify()
        return pb.LeaveSessionResponse(fused_revision=revision)

    def _take_in(self, request: pb.ContributeSubsetsRequest) -> pb.SubsetOutcome:
        """Store one block; a bad one is an outcome, and only what concerns the whole stream is raised."""
        agent_id = self._team.session(request.session_id).agent_id
        size = len(request.subset)
        sent = (
            TrafficCounters(handover_bytes=size)
            if request.purpose == pb.PURPOSE_HANDOVER
            else TrafficCounters(roi_bytes=size)
        )
        outcome = pb.SubsetOutcome(sequence=request.sequence)
        try:
            subset, grid = decode_subset(request.subset)
            put = self._team.contribute(request.session_id, subset, grid)
        except _ENDS_THE_STREAM:
            raise
        except GaussLiteError as error:
            outcome.status, outcome.reason, outcome.message = _REJECTED, code_and_reason(error)[1], str(error)
            self._team.note(agent_id, sent.plus(TrafficCounters(subsets_rejected=1)))
            return outcome
        accepted = len(put.accepted) > 0 or len(put.stale) == 0
        outcome.status = _ACCEPTED if accepted else _STALE
        outcome.accepted_voxels, outcome.stale_voxels = len(put.accepted), len(put.stale)
        self._team.note(
            agent_id, sent.plus(TrafficCounters(subsets_accepted=int(accepted), subsets_stale=int(not accepted)))
        )
        return outcome

    def _take_view(self, request: pb.ContributeKeyframesRequest) -> None:
        agent_id = self._team.session(request.session_id).agent_id
        self._team.add_keyframe(AgentKeyframe(agent_id, frame_from_message(request.keyframe)))

    def _catch_up(self, revision: int) -> Changes:
        try:
            return self._team.changes(revision)
        except RevisionGoneError:
            # the watcher slept through more than is remembered: it starts anew, as the snapshot mark tells it
            return self._team.changes()

    def _export(self, request: pb.ExportFusedMapRequest) -> tuple[bytes, int]:
        data = ply_bytes(self._chosen(request).gaussians)
        return data, google_crc32c.value(data)

    def _chosen(self, request: pb.ExportFusedMapRequest) -> VoxelBatch:
        match request.strategy:
            case pb.FUSION_STRATEGY_VOTE:
                return self._team.voted(request.agent_id)
            case pb.FUSION_STRATEGY_CONCATENATION:
                return self._team.concatenated(request.agent_id)
            case pb.FUSION_STRATEGY_REFINED if not request.agent_id:
                return self._team.refined()
            case pb.FUSION_STRATEGY_REFINED:
                raise InvalidInputError("agent_id: expected none with REFINED, whose Gaussians belong to everyone")
            case other:
                raise InvalidInputError(f"strategy: expected VOTE, CONCATENATION or REFINED, got {other}")

    async def _work(self, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Run in a worker thread, unless the server is draining."""
        self._door.require_open()
        return await asyncio.get_running_loop().run_in_executor(self._workers, function, *arguments)


def _next_block(blocks: Iterator[MapBlock]) -> MapBlock | None:
    return next(blocks, None)


def _contribution_to_message(agent: AgentContribution) -> pb.AgentContribution:
    return pb.AgentContribution(
        agent_id=agent.agent_id,
        joined=agent.joined,
        gaussians=agent.gaussians,
        voxels=agent.voxels,
        won_voxels=agent.won_voxels,
        roi_bytes=agent.tally.roi_bytes,
        handover_bytes=agent.tally.handover_bytes,
        subsets_accepted=agent.tally.subsets_accepted,
        subsets_stale=agent.tally.subsets_stale,
        subsets_rejected=agent.tally.subsets_rejected,
        keyframes=agent.keyframes,
        kappa_sum=agent.kappa_sum,
        last_map_revision=agent.last_map_revision,
        last_seen_ns=agent.tally.last_seen_ns,
    )
