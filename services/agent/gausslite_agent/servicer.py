"""AgentService over a robot: decode, call, encode."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_operations import crop_to_box
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.task.parser import TaskParser
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.v1 import agent_service_pb2_grpc as pb_grpc
from gausslite.wire.change_notifier import ChangeNotifier
from gausslite.wire.convert import (
    box_from_message,
    camera_from_message,
    frame_from_message,
    graph_from_message,
    graph_to_message,
    transform_from_message,
)
from gausslite.wire.map_blocks import map_blocks
from gausslite.wire.server import Service
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.map_changes import MapChangeLog
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.messages import blank_view, report_to_message, status_to_message, view_to_message
from gausslite_agent.mission_runner import MissionState
from gausslite_agent.status import FrameReport

_OUTCOMES_AHEAD = 16


class AgentServicer(pb_grpc.AgentServiceServicer):
    """Serves one robot. `news` rings when the map changed; `state` says where the mission is."""

    def __init__(
        self,
        agent_id: str,
        robot: MappingWorker,
        parser: TaskParser,
        news: ChangeNotifier,
        state: Callable[[], MissionState],
    ) -> None:
        self._agent_id, self._robot, self._parser, self._news, self._state = agent_id, robot, parser, news, state
        # touched on the robot's worker only
        self._histories = {roi_only: MapChangeLog(robot.grid, roi_only) for roi_only in (False, True)}

    def service(self) -> Service:
        """Ready for a server."""
        name = pb.DESCRIPTOR.services_by_name["AgentService"].full_name
        return Service(name, lambda server: pb_grpc.add_AgentServiceServicer_to_server(self, server))

    async def AssignTask(self, request: pb.AssignTaskRequest, _context: Any) -> pb.AssignTaskResponse:  # noqa: N802
        """Take a task in words or as a graph."""
        graph = await self._read_task(request)
        await asyncio.wrap_future(self._robot.assign(graph))
        return pb.AssignTaskResponse(graph=graph_to_message(graph))

    async def IngestFrames(  # noqa: N802
        self, request_iterator: AsyncIterator[pb.IngestFramesRequest], _context: Any
    ) -> AsyncIterator[pb.IngestFramesResponse]:
        """Frames in, one outcome for each, in order."""
        outcomes: asyncio.Queue[asyncio.Future[FrameReport] | None] = asyncio.Queue(_OUTCOMES_AHEAD)
        reader = asyncio.ensure_future(self._read_frames(request_iterator, outcomes))
        try:
            while (outcome := await outcomes.get()) is not None:
                yield report_to_message(await outcome)
            await reader
        finally:
            reader.cancel()

    async def GetAgentStatus(  # noqa: N802
        self, _request: pb.GetAgentStatusRequest, _context: Any
    ) -> pb.GetAgentStatusResponse:
        """How the robot and its uplink are doing."""
        uplink = self._robot.uplink
        counters = UplinkCounters() if uplink is None else uplink.counters()
        return status_to_message(self._agent_id, self._state(), self._robot.status(), counters)

    async def RenderView(self, request: pb.RenderViewRequest, _context: Any) -> pb.RenderViewResponse:  # noqa: N802
        """Draw the map from a pose."""
        camera = camera_from_message(request.camera)
        T_world_camera = transform_from_message("t_world_camera", request.t_world_camera)

        def draw(mapper: GaussianMapper) -> pb.RenderViewResponse:
            revision = self._robot.revision()
            if mapper.count == 0:
                return blank_view(camera, revision)
            return view_to_message(mapper.render(camera, T_world_camera), revision)

        return await asyncio.wrap_future(self._robot.do(draw))

    async def WatchMap(  # noqa: N802
        self, request: pb.WatchMapRequest, _context: Any
    ) -> AsyncIterator[pb.WatchMapResponse]:
        """A snapshot, then what changed; a slow reader finds changes summed up, never queued."""
        region = box_from_message(request.region) if request.HasField("region") else None
        history = self._histories[request.roi_only]
        since = request.since_revision

        def catch_up(mapper: GaussianMapper) -> list[pb.WatchMapResponse]:
            history.update(mapper.gaussians(), self._robot.revision())
            words = history.since(since)
            if region is not None:
                words = crop_to_box(words, region, self._robot.grid)
            blocks = map_blocks(words, self._robot.grid, self._agent_id, history.revision, snapshot=since == 0)
            return [pb.WatchMapResponse(block=block) for block in blocks]

        while True:
            ticket = self._news.subscribe()
            if since == 0 or since != self._robot.revision():
                for response in await asyncio.wrap_future(self._robot.do(catch_up)):
                    yield response
                    since = response.block.revision
            await ticket.wait()

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
                await outcomes.put(await self._take(request))
        except Exception:
            # the outcomes so far are still told; then the stream ends with this error
            await outcomes.put(None)
            raise
        await outcomes.put(None)

    async def _take(self, request: pb.IngestFramesRequest) -> asyncio.Future[FrameReport]:
        try:
            frame = await asyncio.to_thread(frame_from_message, request.frame)
        except InvalidInputError as error:
            rejected: asyncio.Future[FrameReport] = asyncio.get_running_loop().create_future()
            rejected.set_result(self._robot.reject(request.frame.index, str(error)))
            return rejected
        return asyncio.wrap_future(self._robot.submit(frame))
