"""The AgentService: decode a request, call the mapping worker, encode the response."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.task import TaskGraph
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.live_frame import correct_live_frame
from gausslite.task.parser import TaskParser
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.v1 import agent_service_pb2_grpc as pb_grpc
from gausslite.wire.camera_view import camera_view_to_message
from gausslite.wire.change_notifier import ChangeNotifier
from gausslite.wire.convert import (
    box_from_message,
    camera_from_message,
    live_frame_from_message,
    transform_from_message,
)
from gausslite.wire.convert_task import graph_from_message, graph_to_message
from gausslite.wire.map_changes import EncodedPartCache, follow
from gausslite.wire.server import Service
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.agent_mission import AgentMission
from gausslite_agent.map_changes import AgentMapReader, MapChangeLog, MapChanges
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.messages import (
    blank_view,
    report_to_message,
    status_to_message,
    summary_to_message,
    view_to_message,
)
from gausslite_agent.status import FrameReport

_OUTCOMES_AHEAD = 16


class AgentServicer(pb_grpc.AgentServiceServicer):
    """Serves one robot. changes: notified after each change of the map."""

    def __init__(
        self,
        agent_id: str,
        worker: MappingWorker,
        mission: AgentMission,
        parser: TaskParser,
        changes: ChangeNotifier,
    ) -> None:
        self._agent_id, self._worker, self._mission = agent_id, worker, mission
        self._parser, self._changes = parser, changes
        self._encoded_parts = EncodedPartCache()
        # used on the worker thread only
        self._change_logs = {roi_only: MapChangeLog(worker.grid, roi_only) for roi_only in (False, True)}

    def service(self) -> Service:
        """Return the service to register with a server."""
        name = pb.DESCRIPTOR.services_by_name["AgentService"].full_name
        return Service(name, lambda server: pb_grpc.add_AgentServiceServicer_to_server(self, server))

    async def AssignTask(self, request: pb.AssignTaskRequest, _context: Any) -> pb.AssignTaskResponse:  # noqa: N802
        """Assign a task, given as text or as a graph."""
        graph = await self._read_task(request)
        await asyncio.to_thread(self._mission.assign, graph)
        return pb.AssignTaskResponse(graph=graph_to_message(graph))

    async def IngestFrames(  # noqa: N802
        self, request_iterator: AsyncIterator[pb.IngestFramesRequest], _context: Any
    ) -> AsyncIterator[pb.IngestFramesResponse]:
        """Map a stream of frames; yield one outcome for each, in order."""
        outcomes: asyncio.Queue[asyncio.Future[FrameReport] | None] = asyncio.Queue(_OUTCOMES_AHEAD)
        reader = asyncio.ensure_future(self._read_frames(request_iterator, outcomes))
        try:
            while (outcome := await outcomes.get()) is not None:
                yield report_to_message(await outcome)
            await reader
        finally:
            reader.cancel()

    async def EndMission(  # noqa: N802
        self, request: pb.EndMissionRequest, _context: Any
    ) -> pb.EndMissionResponse:
        """End the mission; return what was sent and left."""
        end = self._mission.end_by_options
        if request.HasField("handover"):
            end = replace(end, handover=request.handover)
        if request.HasField("drain_seconds"):
            end = replace(end, drain_s=request.drain_seconds)
        summary = await asyncio.to_thread(self._mission.end, end)
        return summary_to_message(self._mission.state, summary)

    async def GetAgentStatus(  # noqa: N802
        self, _request: pb.GetAgentStatusRequest, _context: Any
    ) -> pb.GetAgentStatusResponse:
        """Return the status of the robot and its uplink."""
        uplink = self._worker.uplink
        counters = UplinkCounters() if uplink is None else uplink.counters()
        return status_to_message(self._agent_id, self._mission, self._worker.status(), counters)

    async def RenderView(self, request: pb.RenderViewRequest, _context: Any) -> pb.RenderViewResponse:  # noqa: N802
        """Render the map from a pose."""
        camera = camera_from_message(request.camera)
        T_world_camera = transform_from_message("t_world_camera", request.t_world_camera)

        def render(mapper: GaussianMapper) -> pb.RenderViewResponse:
            revision = self._worker.revision()
            if mapper.count == 0:
                return blank_view(camera, revision)
            rendering = mapper.render(camera, T_world_camera)
            return view_to_message(rendering.rgb, rendering.expected_depth_m(), revision)

        return await asyncio.wrap_future(self._worker.run(render))

    async def GetCameraView(  # noqa: N802
        self, _request: pb.GetCameraViewRequest, _context: Any
    ) -> pb.GetCameraViewResponse:
        """Return the newest keyframe, the camera's path and the newest detection."""
        view = await asyncio.wrap_future(self._worker.camera_view())
        return await asyncio.to_thread(camera_view_to_message, view)

    async def WatchMap(  # noqa: N802
        self, request: pb.WatchMapRequest, _context: Any
    ) -> AsyncIterator[pb.WatchMapResponse]:
        """Yield a snapshot of the map, then its changes. A slow reader gets merged changes; nothing is queued."""
        region = box_from_message(request.region) if request.HasField("region") else None
        change_log = self._change_logs[request.roi_only]

        async def read(since_revision: int) -> AgentMapReader:
            def read_changes(mapper: GaussianMapper) -> MapChanges:
                change_log.update(mapper.gaussians(), self._worker.revision())
                return change_log.since(since_revision)

            changes = await asyncio.wrap_future(self._worker.run(read_changes))
            return AgentMapReader(changes, region, self._worker.grid, self._agent_id, self._encoded_parts)

        blocks = follow(read, self._worker.revision, request.since_revision, self._changes, asyncio.to_thread)
        async for block in blocks:
            yield pb.WatchMapResponse(block=block)

    async def _read_task(self, request: pb.AssignTaskRequest) -> TaskGraph:
        match request.WhichOneof("task"):
            case "text":
                return await asyncio.to_thread(self._parser.parse, request.text)
            case "graph":
                return graph_from_message(request.graph)
            case _:
                raise InvalidInputError("task: expected a text or a graph, got neither")

    async def _read_frames(
        self,
        requests: AsyncIterator[pb.IngestFramesRequest],
        outcomes: asyncio.Queue[asyncio.Future[FrameReport] | None],
    ) -> None:
        try:
            async for request in requests:
                await outcomes.put(await self._submit(request))
        except Exception:
            # the outcomes so far are still sent; then the stream ends with this error
            await outcomes.put(None)
            raise
        await outcomes.put(None)

    async def _submit(self, request: pb.IngestFramesRequest) -> asyncio.Future[FrameReport]:
        try:
            frame = await asyncio.to_thread(_decode_frame, request)
        except InvalidInputError as error:
            rejected: asyncio.Future[FrameReport] = asyncio.get_running_loop().create_future()
            rejected.set_result(self._worker.reject(request.frame.index, str(error)))
            return rejected
        return asyncio.wrap_future(self._mission.submit(frame))


def _decode_frame(request: pb.IngestFramesRequest) -> Frame:
    """Return the frame without lens distortion and rolling shutter. Raises InvalidInputError and subclasses."""
    return correct_live_frame(*live_frame_from_message(request.frame))
