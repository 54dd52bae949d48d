"""The methods of FusionService: each one decodes, calls the fusion engine and encodes."""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any, TypeVar

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.codec.subset_codec import MAX_SUBSET_BYTES
from gausslite.domain.errors import GaussLiteError, InvalidInputError, QuotaError, UnavailableError
from gausslite.domain.objects import ObjectReport, TeamObject
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.engine import FusionEngine, WorkDone
from gausslite.fusion.limits import MissionConfig, SessionRecord
from gausslite.fusion.refinement import CreateRasterizer, RefineSettings
from gausslite.plugins import Group, find, load
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.v1 import geometry_pb2
from gausslite.wire import convert
from gausslite.wire.call_limits import RejectionLog
from gausslite.wire.convert_task import graph_from_message, object_to_message, report_from_message
from gausslite.wire.map_changes import EncodedPartCache, follow, read_deadline
from gausslite.wire.security import Caller
from gausslite.wire.server import Service
from gausslite.wire.views import MAX_VIEWS_WAITING, ChangeNotifier, view_camera_from_message, view_to_pngs
from gausslite.wire.worker_pool import WorkerPool
from gausslite_fusion_server import messages
from gausslite_fusion_server.contributions import Acknowledger, StoredCount
from gausslite_fusion_server.plugins import MapRenderer, OpenRefiner, OpenRenderer, Refiner
from gausslite_fusion_server.watch import FusedMapReader, watch_filter

_Message = TypeVar("_Message")
_log = logging.getLogger(__name__)
MAX_REPORTED_REJECTIONS = 1000
_WORKERS, _MAX_WAITING = 4, 1024
_KEYFRAME_PAUSE = 2.0
"""Pause after a keyframe is stored, in the time that storing took."""
_ALIGN_DELAY_S = 0.1
"""The messages of this time share one look at which frames are due."""
_JUDGE_DELAY_S = 10.0
"""The messages and keyframes of this time share one judgement of the voxels."""
_PAUSE = 4.0
"""Pause after background work, in its durations: it takes a fifth of a core at most."""
_RETRY_S = 30.0
_Result = TypeVar("_Result")


class DrainGate:
    """Open until `close` is called. Use it on the event loop only."""

    def __init__(self) -> None:
        self.is_open = True
        self._readings: set[asyncio.Future[Any]] = set()

    def close(self) -> None:
        """Refuse new calls and end the streams read through `admit`."""
        self.is_open = False
        for reading in self._readings:
            reading.cancel()

    def require_open(self) -> None:
        """Raise UnavailableError if the server drains."""
        if not self.is_open:
            raise UnavailableError("fusion server: draining; try again in a moment")

    async def admit(self, requests: AsyncIterator[_Message]) -> AsyncIterator[_Message]:
        """Yield the requests of a stream. Raises UnavailableError when the gate closes, even between two requests."""
        while True:
            self.require_open()
            reading = asyncio.ensure_future(anext(requests, None))
            self._readings.add(reading)
            reading.add_done_callback(self._end)
            try:
                request = await reading
            except asyncio.CancelledError:
                self.require_open()
                raise
            if request is None:
                return
            yield request

    def _end(self, reading: asyncio.Future[Any]) -> None:
        self._readings.discard(reading)
        if not reading.cancelled():
            # a call that is cancelled during the wait never reads an invalid request's error
            reading.exception()


class BackgroundWork:
    """Works in a thread while something is due, with pauses in which others have the disk and the processor."""

    def __init__(self, work: Callable[[], WorkDone], notify: Callable[[], None], failure: str, delay_s: float) -> None:
        """notify: called after changes. failure: what an error means. delay_s: the shortest pause."""
        self._work, self._notify, self._failure = work, notify, failure
        self._delay_s = self._pause_s = delay_s
        self._executor = ThreadPoolExecutor(1, "background")
        self._task: asyncio.Task[None] | None = None
        self._is_due, self._is_open = False, True

    def wake(self) -> None:
        """Work soon, unless that is pending or running. Use it on the event loop."""
        self._is_due = True
        if self._is_open and (self._task is None or self._task.done()):
            self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while self._is_due:
            await asyncio.sleep(self._pause_s)
            # messages that arrive meanwhile set it again
            self._is_due, start_s = False, loop.time()
            try:
                done = await loop.run_in_executor(self._executor, self._work)
                self._pause_s = max(self._delay_s, _PAUSE * (loop.time() - start_s))
            except Exception as error:
                _log.error("%s, again in %.0f s: %s", self._failure, _RETRY_S, error)
                # a part may have been done before
                done, self._pause_s = WorkDone(is_changed=True, is_due=True), _RETRY_S
            self._is_due |= done.is_due
            if done.is_changed:
                self._notify()

    def cancel(self) -> None:
        """End before the next work."""
        self._is_open = False
        if self._task is not None:
            self._task.cancel()

    def close(self) -> None:
        """Wait until the work in the thread has ended."""
        self._executor.shutdown(wait=True, cancel_futures=True)


# ruff: noqa: N802, ARG002 - the methods' names and arguments are those of the generated base class


class FusionServicer(pb_grpc.FusionServiceServicer):
    """Serves one fused map. All work runs in threads, so that the event loop always answers health checks."""

    def __init__(self, engine: FusionEngine, refine: RefineSettings, create_rasterizer: CreateRasterizer) -> None:
        self.engine = engine
        self._refine, self._create_rasterizer = refine, create_rasterizer
        create: OpenRefiner | None = find(Group.REFINERS)
        self._refiner: Refiner | None = None if create is None else create(create_rasterizer)
        self._renderer: MapRenderer | None = None
        self._workers = WorkerPool("fusion server", _WORKERS, _MAX_WAITING)
        # one thread: messages that arrive during a commit wait for the next one and share it
        self._committer = ThreadPoolExecutor(1, "commit")
        self._commit_is_due = False
        self._encoded_parts = EncodedPartCache()
        # one thread each: a comparison of frames or a rendering must not delay the acknowledgements; encoding included
        self._views = WorkerPool("views", waiting=MAX_VIEWS_WAITING)
        self._map_changes = ChangeNotifier()
        align, notify = functools.partial(engine.align_due, 1), self._map_changes.notify
        self._judging = BackgroundWork(self._judge, notify, "voxels are not judged by keyframes", _JUDGE_DELAY_S)
        self._aligning = BackgroundWork(align, self._publish, "frames are not compared", _ALIGN_DELAY_S)
        self._slices = BackgroundWork(engine.work_in_background, self._publish, "maps are not moved or deleted", 0.0)
        self._gate = DrainGate()
        self._rejections = RejectionLog(_log)
        # one at a time: they hold megabytes, the interpreter's lock, or the engine's lock during several transactions
        self._exports, self._queries, self._joins = (WorkerPool(name) for name in ("exports", "queries", "joins"))
        self._keyframes = WorkerPool("keyframes", pause=_KEYFRAME_PAUSE)
        # the latest answer: thousands of observers take 30 ms of Python to encode
        self._found: tuple[tuple[TeamObject, ...], pb.QueryObjectsResponse] = (), pb.QueryObjectsResponse()

    def service(self) -> Service:
        """Return the servicer, ready for a server."""
        return Service(
            "gausslite.v1.FusionService",
            functools.partial(pb_grpc.add_FusionServiceServicer_to_server, self),
            self.engine.storage.check,
            self.engine.acknowledgements.check,
        )

    def drain(self) -> None:
        """End every open stream and every later call with UNAVAILABLE."""
        self._gate.close()
        for work in (self._aligning, self._slices, self._judging):
            work.cancel()
        self._map_changes.notify()

    async def store_message(self, session: SessionRecord, message: bytes | EncodedSubset) -> StoredCount:
        """Store a message, or a decoded part of one. Raises UnavailableError, and as FusionEngine.contribute."""
        self._gate.require_open()
        put = self.engine.enqueue_update(session, message)
        self._commit_soon()
        try:
            stored = await asyncio.wrap_future(put)
            return StoredCount(len(stored.accepted), len(stored.stale))
        finally:
            self.publish_changes()

    def publish_changes(self) -> None:
        """Wake the watchers, and look which frames and voxels are due. Use it on the event loop."""
        self._publish()
        if self.engine.frames.are_compared:
            self._aligning.wake()
        if self.engine.has_background_work:
            self._slices.wake()

    def _publish(self) -> None:
        self._map_changes.notify()
        self._judging.wake()

    def _judge(self) -> WorkDone:
        return WorkDone(False, False) if self._refiner is None else self._refiner.judge(self.engine)

    def _commit_soon(self) -> None:
        """Commit what is queued in the commit thread; one call serves all messages queued before it begins."""
        if not self._commit_is_due:
            self._commit_is_due = True
            self._committer.submit(self._commit)

    def _commit(self) -> None:
        self._commit_is_due = False
        self.engine.commit_updates()

    def close(self) -> None:
        """Wait until the work in threads has ended."""
        pools = self._views, self._exports, self._queries, self._joins, self._keyframes, self._workers
        refiner = () if self._refiner is None else (self._refiner,)
        for part in (*refiner, self._aligning, self._slices, self._judging, *pools):
            part.close()
        self._committer.shutdown(wait=True)

    async def JoinSession(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        """Join the mission."""
        Caller.of(context).require_agent(request.agent_id)
        grid = VoxelGrid(request.grid.size_m)
        requested = MissionConfig(request.mission_id, request.world_frame, grid.size_m)
        task = graph_from_message(request.task) if request.HasField("task") else None
        messages.declared_frame_from_message(request)
        self._gate.require_open()
        joined = await self._joins.run(
            context, self.engine.join, request.agent_id, requested, request.fresh_map, request.token
        )
        await self._work(context, messages.declare_frame, self.engine, request)
        if task is not None:
            objects = await self._work(context, self.engine.objects.of_task, request.agent_id, task)
            await self._work(context, self.engine.objects.report, joined.session, ObjectReport(task, objects))
        self.publish_changes()
        return pb.JoinSessionResponse(
            session_id=joined.session.session_id,
            highest_update_seq=joined.highest_update_seq,
            fused_revision=joined.fused_revision,
            grid=geometry_pb2.VoxelGrid(size_m=self.engine.grid.size_m),
            max_subset_bytes=MAX_SUBSET_BYTES,
            max_gaussians=self.engine.settings.quotas.gaussians_per_agent,
            keyframes=joined.keyframes,
            max_keyframes=self.engine.settings.quotas.keyframes_per_agent,
            incarnation_id=self.engine.store.incarnation_id,
        )

    async def KeepSession(self, request: pb.KeepSessionRequest, context: Any) -> pb.KeepSessionResponse:
        """Renew the agent's lease; return what identifies the stored updates."""
        return await self._work(context, messages.kept_session, self.engine, request, Caller.of(context))

    async def GetUpdateDigests(
        self, request: pb.GetUpdateDigestsRequest, context: Any
    ) -> AsyncIterator[pb.GetUpdateDigestsResponse]:
        """Return the digests of the agent's stored updates."""
        agent_id = (await self._session(request.session_id, context)).agent_id
        for block in convert.digests_to_messages(await self._work(context, self.engine.store.digests, agent_id)):
            with read_deadline():
                yield block

    async def ContributeSubsets(
        self, request_iterator: AsyncIterator[pb.ContributeSubsetsRequest], context: Any
    ) -> AsyncIterator[pb.ContributeSubsetsResponse]:
        """Store voxel updates; one acknowledgement for each message."""
        session = None
        stream = Acknowledger(Caller.of(context), self.engine.traffic, self._rejections)
        async for request in self._gate.admit(request_iterator):
            if session is None or session.session_id != request.session_id:
                session = await self._session(request.session_id, context)
            try:
                stored = await self.store_message(session, request.subset)
                answer = stream.accept(request, session.agent_id, stored)
            except GaussLiteError as error:
                answer = stream.refuse(request, session.agent_id, error)
            yield answer

    async def ContributeKeyframes(
        self, request_iterator: AsyncIterator[pb.ContributeKeyframesRequest], context: Any
    ) -> pb.ContributeKeyframesResponse:
        """Store keyframes for the refinement; invalid ones are reported and the others stored."""
        response, caller = pb.ContributeKeyframesResponse(), Caller.of(context)
        async for request in self._gate.admit(request_iterator):
            try:
                self._gate.require_open()
                await self._keyframes.run(context, messages.store_keyframe, self.engine, request, caller)
                response.accepted += 1
            except (InvalidInputError, QuotaError) as error:
                if len(response.rejected) >= MAX_REPORTED_REJECTIONS:
                    raise
                response.rejected.add(index=request.keyframe.index, reason=str(error))
        self._aligning.wake()  # they may show where an unknown frame is
        self._judging.wake()
        return response

    async def GetKeyframe(self, request: pb.GetKeyframeRequest, context: Any) -> pb.GetKeyframeResponse:
        """Return a stored keyframe of an agent, for a person."""
        self.engine.members.require_mission(request.mission_id)
        return await self._work(context, messages.read_keyframe, self.engine, request)

    async def WatchFusedMap(
        self, request: pb.WatchFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """Send the map, then its changes. A slow watcher gets several changes as one; nothing is queued."""
        self.engine.members.require_mission(request.mission_id)
        watched = watch_filter(request)
        reader = FusedMapReader(self.engine, watched, self._encoded_parts, request.since_revision)

        async def read(_since_revision: int) -> FusedMapReader:
            return reader

        work = functools.partial(self._work, context)

        def revision() -> int:
            self._gate.require_open()
            return self.engine.maps.revision(watched.layer)

        async for block in follow(read, revision, request.since_revision, self._map_changes, work):
            yield pb.WatchFusedMapResponse(block=block)

    async def RefineFusedMap(
        self, request: pb.RefineFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.RefineFusedMapResponse]:
        """Refine the fused map and report progress; closing the stream cancels the refinement."""
        self._gate.require_open()
        self.engine.members.require_mission(request.mission_id)
        settings = messages.refine_settings(self._refine, request)
        refiner: Refiner = self._refiner or load(Group.REFINERS, purpose="refinement")
        response = pb.RefineFusedMapResponse()
        async for progress in refiner.run(self.engine, settings):
            self._gate.require_open()
            response = pb.RefineFusedMapResponse(**asdict(progress))
            yield response
        self._map_changes.notify()
        response.done = True
        yield response

    async def ExportFusedMap(
        self, request: pb.ExportFusedMapRequest, context: Any
    ) -> AsyncIterator[pb.ExportFusedMapResponse]:
        """Send a map as the bytes of a PLY file."""
        self.engine.members.require_mission(request.mission_id)

        def export() -> messages.ExportedFile:
            world_frame = self.engine.members.mission_config.given_world_frame
            return messages.ExportedFile(messages.select_map(self.engine, request), world_frame)

        self._gate.require_open()
        exported = await self._exports.run(context, export)
        async for chunk in exported.chunks():
            self._gate.require_open()
            yield chunk

    async def ReportObjects(self, request: pb.ReportObjectsRequest, context: Any) -> pb.ReportObjectsResponse:
        """Replace the agent's task graph and objects."""
        session = await self._session(request.session_id, context)
        await self._work(context, self.engine.objects.report, session, report_from_message(request))
        return pb.ReportObjectsResponse()

    async def QueryObjects(self, request: pb.QueryObjectsRequest, context: Any) -> pb.QueryObjectsResponse:
        """Return the team's objects that a noun names, or all."""
        self.engine.members.require_mission(request.mission_id)
        self._gate.require_open()
        return await self._queries.run(context, self._find_objects, request.noun)

    def _find_objects(self, noun: str) -> pb.QueryObjectsResponse:
        found = self.engine.query_objects(noun)
        if found != self._found[0]:
            objects = [object_to_message(one.landmark, one.observers) for one in found]
            self._found = found, pb.QueryObjectsResponse(objects=objects)
        return self._found[1]

    async def RenderView(self, request: pb.RenderFusedViewRequest, context: Any) -> pb.RenderFusedViewResponse:
        """Render a layer of the map from a camera pose."""
        self._gate.require_open()
        self.engine.members.require_mission(request.mission_id)
        camera = view_camera_from_message(request.camera)
        T_world_camera = convert.transform_from_message("t_world_camera", request.t_world_camera)
        layer = messages.layer_from_message(request.layer)

        def work() -> pb.RenderFusedViewResponse:
            if self._renderer is None:
                create: OpenRenderer = load(Group.MAP_RENDERERS, purpose="views of the fused map")
                self._renderer = create(self.engine.maps, self._create_rasterizer)
            rendering, revision = self._renderer.render(camera, T_world_camera, layer)
            return pb.RenderFusedViewResponse(**view_to_pngs(camera, rendering), revision=revision)

        return await self._views.run(context, work)

    async def GetSessionStatus(self, request: pb.GetSessionStatusRequest, context: Any) -> pb.GetSessionStatusResponse:
        """Return the figures of the mission and of each agent."""
        self.engine.members.require_mission(request.mission_id)
        status = await self._work(context, self.engine.status)
        return pb.GetSessionStatusResponse(
            mission_id=status.mission_config.mission_id,
            grid=geometry_pb2.VoxelGrid(size_m=self.engine.grid.size_m),
            world_frame=status.mission_config.world_frame,
            fused_revision=status.revision,
            agents=map(messages.contribution_to_message, status.agents),
            **convert.values_of(status, ("fused_gaussians", "fused_voxels", "keyframes", "refined", "banned_agents")),
        )

    async def LeaveSession(self, request: pb.LeaveSessionRequest, context: Any) -> pb.LeaveSessionResponse:
        """End a session; with `forget` the agent's updates are deleted."""
        await self._session(request.session_id, context)
        revision = await self._work(context, self.engine.leave, request.session_id, request.forget)
        self.publish_changes()
        return pb.LeaveSessionResponse(fused_revision=revision)

    async def EvictAgent(self, request: pb.EvictAgentRequest, context: Any) -> pb.EvictAgentResponse:
        """End an agent's session and delete its data; with `ban` its later joins are refused."""
        self.engine.members.require_mission(request.mission_id)
        voxels = await self._work(context, self.engine.evict, request.agent_id, request.ban)
        self.publish_changes()
        _log.warning(
            "agent %s: %s, data of %d voxels deleted", request.agent_id, "banned" if request.ban else "evicted", voxels
        )
        return pb.EvictAgentResponse(fused_revision=self.engine.maps.revision(), voxels=voxels)

    async def UnbanAgent(self, request: pb.UnbanAgentRequest, context: Any) -> pb.UnbanAgentResponse:
        """Let a banned agent join again."""
        self.engine.members.require_mission(request.mission_id)
        await self._work(context, self.engine.unban, request.agent_id)
        _log.warning("agent %s: may join again", request.agent_id)
        return pb.UnbanAgentResponse()

    async def _session(self, session_id: str, context: Any) -> SessionRecord:
        """Return a session. Raises SessionUnknownError, NotPermittedError if the caller is another robot."""
        caller = Caller.of(context)
        if self.engine.members.sessions.known(session_id) is None:
            # it asks the store
            return await self._work(context, messages.session_of, self.engine, session_id, caller)
        return messages.session_of(self.engine, session_id, caller)

    async def _work(self, context: Any, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Run the function in a worker thread. Raises UnavailableError if the server drains, RateLimitError."""
        self._gate.require_open()
        return await self._workers.run(context, function, *arguments)
