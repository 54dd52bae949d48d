"""The AgentService: decode a request, call the mapping worker, encode the response."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Hashable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gausslite.codec.subset_codec import split_batch
from gausslite.datasets.calibration import open_calibrator
from gausslite.domain.errors import InvalidInputError, MismatchError, RevisionGoneError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.domain.voxel_changes import VoxelChangeTracker, VoxelSignatures
from gausslite.domain.voxels import (
    VoxelBatch,
    VoxelGrid,
    VoxelIndex,
    crop_to_box,
    empty_batch,
    merge_batches,
    select_keys,
    tombstones,
)
from gausslite.fusion.change_log import VoxelLog
from gausslite.mapping.mapper import GaussianMapper
from gausslite.render.rasterizer import Rendering
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.v1 import agent_service_pb2_grpc as pb_grpc
from gausslite.wire.convert import box_from_message, live_frame_from_message, transform_from_message
from gausslite.wire.convert_task import assigned_from_message, graph_to_message
from gausslite.wire.map_changes import BLOCK_BYTES, EncodedPart, EncodedPartCache, Parts, encode_parts, follow
from gausslite.wire.server import Service
from gausslite.wire.update_sender import UplinkCounters
from gausslite.wire.views import (
    MAX_VIEWS_WAITING,
    ChangeNotifier,
    camera_view_to_message,
    view_camera_from_message,
    view_to_pngs,
)
from gausslite.wire.worker_pool import WorkerPool
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.messages import frame_report_to_message, status_to_message, summary_to_message
from gausslite_agent.mission import AgentMission
from gausslite_agent.state import FrameReport

# ruff: noqa: N802 - the methods' names are those of the generated base class

_OUTCOMES_AHEAD = 16
_ENCODERS, _MAX_WATCHERS_WAITING = 2, 1024


class MapChangeLog:
    """The map's voxels at its latest revision, and the revision at which each last changed. Not thread-safe."""

    def __init__(self, grid: VoxelGrid, roi_only: bool) -> None:
        self._grid = grid
        self._roi_only = roi_only
        self._tracker = VoxelChangeTracker()
        self._log: VoxelLog | None = None
        self._batch = empty_batch()

    @property
    def revision(self) -> int:
        """The revision of the last update; 0 before the first."""
        return 0 if self._log is None else self._log.revision

    def update(self, gaussians: Gaussians, revision: int) -> None:
        """Compare the map with its last update; a revision that is not newer changes nothing."""
        if self._log is not None and revision <= self._log.revision:
            return
        shown = gaussians.take(gaussians.active) if self._roi_only else gaussians
        voxels = VoxelIndex.from_points(shown.means_m, self._grid)
        signatures = VoxelSignatures.from_gaussians(shown, voxels)
        changed, removed = self._tracker.update(signatures)
        counts = voxels.counts.astype(np.uint32)
        self._batch = VoxelBatch(voxels.keys, signatures.kappa_sums.copy(), counts, shown.take(voxels.rows))
        if self._log is None:
            self._log = VoxelLog(revision)
        self._log.record(signatures.keys[changed], removed, revision=revision)
        self._log.revision = revision  # also of a map that is the same as before

    def since(self, revision: int) -> VoxelBatch:
        """Return updates of all voxels that changed after a revision; 0: the whole map. Raises RevisionGoneError."""
        if revision == 0:
            return self._batch
        if self._log is None:
            raise RevisionGoneError(f"since_revision: expected 0 before the first revision, got {revision}")
        keys = self._log.changed_since(revision)
        present = select_keys(self._batch, keys)
        return merge_batches(present, tombstones(np.setdiff1d(keys, present.keys)))


@dataclass(frozen=True, slots=True, eq=False)
class AgentMapReader:
    """Reads voxels that lead to a revision."""

    revision: int
    batch: VoxelBatch
    key: tuple[Hashable, ...]  # what they are, in the cache of all watchers' encoded parts
    encode: Callable[[VoxelBatch], tuple[EncodedPart, ...]]  # to messages of limited size
    cache: EncodedPartCache  # of all watchers

    def snapshot(self) -> tuple[int, Parts]:
        """Return the revision and, in parts, the voxels: the whole map."""
        return self.revision, self._parts()

    def changes(self, since_revision: int) -> tuple[int, Parts]:
        """Return the revision and, in parts, the voxels; none if the watcher has this revision."""
        return self.revision, () if since_revision == self.revision else self._parts()

    def _parts(self) -> Iterator[tuple[EncodedPart, ...]]:
        for number, part in enumerate(split_batch(self.batch, BLOCK_BYTES)):
            yield self.cache.get((*self.key, self.revision, number), partial(self.encode, part))


class NewestTask:
    """Assigns one task at a time, in a thread; of calls that wait, the newest counts. Use it on the event loop."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "task")
        self._newest: Future[TaskGraph] | None = None

    async def assign(self, assign: Callable[[], TaskGraph]) -> TaskGraph:
        """Return the result of the function. Raises MismatchError if a newer call comes before it begins."""
        future = self._executor.submit(assign)
        if self._newest is not None:
            # without effect on one that has begun
            self._newest.cancel()
        self._newest = future
        assigned = asyncio.wrap_future(future)
        # asyncio logs an error that nobody looks at, as where the caller has gone
        assigned.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait([assigned])
        if future.cancelled():
            raise MismatchError("task: superseded by a newer AssignTask before it was assigned")
        return assigned.result()


class AgentServicer(pb_grpc.AgentServiceServicer):
    """Serves one robot. changes: notified after each change of the map."""

    def __init__(
        self, agent_id: str, worker: MappingWorker, mission: AgentMission, parser: TaskParser, changes: ChangeNotifier
    ) -> None:
        self._agent_id, self._worker, self._mission = agent_id, worker, mission
        self._parser, self._changes = parser, changes
        self._encoded_parts = EncodedPartCache()
        self._newest_task = NewestTask()
        # a thread of its own: calls that wait for the mapper must not delay a frame
        self._decoder = ThreadPoolExecutor(1, "decode")
        # so do these, because the end of a mission and the hash of a whole map take long
        self._ending, self._comparing = ThreadPoolExecutor(1, "end"), WorkerPool("compare", 1, _MAX_WATCHERS_WAITING)
        self._encoding = WorkerPool("watchers", _ENCODERS, _MAX_WATCHERS_WAITING)
        self._views, self._camera_views = (WorkerPool(name, waiting=MAX_VIEWS_WAITING) for name in ("views", "camera"))
        # used on the comparing thread only
        self._change_logs = {roi_only: MapChangeLog(worker.grid, roi_only) for roi_only in (False, True)}

    def service(self) -> Service:
        """Return the service to register with a server."""
        name = pb.DESCRIPTOR.services_by_name["AgentService"].full_name
        return Service(name, lambda server: pb_grpc.add_AgentServiceServicer_to_server(self, server))

    async def AssignTask(self, request: pb.AssignTaskRequest, _context: Any) -> pb.AssignTaskResponse:
        """Assign a task, given as text or as a graph, and what a person points at."""

        def assign() -> TaskGraph:
            return self._mission.assign(assigned_from_message(request, self._parser.parse))

        return pb.AssignTaskResponse(graph=graph_to_message(await self._newest_task.assign(assign)))

    async def IngestFrames(
        self, request_iterator: AsyncIterator[pb.IngestFramesRequest], _context: Any
    ) -> AsyncIterator[pb.IngestFramesResponse]:
        """Map a stream of frames; yield one outcome for each, in order."""
        outcomes: asyncio.Queue[asyncio.Future[FrameReport] | None] = asyncio.Queue(_OUTCOMES_AHEAD)
        reader = asyncio.ensure_future(self._read_frames(request_iterator, outcomes))
        try:
            while (outcome := await outcomes.get()) is not None:
                yield frame_report_to_message(await outcome)
            await reader
        finally:
            reader.cancel()

    async def EndMission(self, request: pb.EndMissionRequest, _context: Any) -> pb.EndMissionResponse:
        """End the mission; return what was sent and left."""
        end = self._mission.end_by_options
        if request.HasField("handover"):
            end = replace(end, handover=request.handover)
        if request.HasField("drain_seconds"):
            end = replace(end, drain_s=request.drain_seconds)
        summary = await asyncio.get_running_loop().run_in_executor(self._ending, self._mission.end, end)
        return summary_to_message(self._mission.state, summary)

    async def GetAgentStatus(self, _request: pb.GetAgentStatusRequest, _context: Any) -> pb.GetAgentStatusResponse:
        """Return the status of the robot and its uplink."""
        uplink = self._worker.uplink
        counters = UplinkCounters() if uplink is None else uplink.counters()
        return status_to_message(self._agent_id, self._mission, self._worker.status(), counters)

    async def RenderView(self, request: pb.RenderViewRequest, context: Any) -> pb.RenderViewResponse:
        """Render the map from a pose, one view at a time, when no frame waits."""
        camera = view_camera_from_message(request.camera)
        T_world_camera = transform_from_message("t_world_camera", request.t_world_camera)

        def render(mapper: GaussianMapper) -> tuple[Rendering | None, int]:
            return mapper.render(camera, T_world_camera) if mapper.table.count > 0 else None, self._worker.revision()

        def work() -> pb.RenderViewResponse:
            # only rendered on the mapper's thread
            rendering, revision = self._worker.run_when_idle(render)
            return pb.RenderViewResponse(**view_to_pngs(camera, rendering), map_revision=revision)

        return await self._views.run(context, work)

    async def GetCameraView(self, _request: pb.GetCameraViewRequest, context: Any) -> pb.GetCameraViewResponse:
        """Return the newest keyframe, the camera's path and the newest detection."""
        return await self._camera_views.run(
            context, lambda: camera_view_to_message(self._worker.camera_view().result())
        )

    async def WatchMap(self, request: pb.WatchMapRequest, context: Any) -> AsyncIterator[pb.WatchMapResponse]:
        """Yield a snapshot of the map, then its changes. A slow reader gets merged changes; nothing is queued."""
        region = box_from_message(request.region) if request.HasField("region") else None
        change_log, grid = self._change_logs[request.roi_only], self._worker.grid

        def read_changes(since_revision: int) -> AgentMapReader:
            # the mapper is only copied on its thread, and once for all watchers of a revision
            if change_log.revision < self._worker.revision():
                copied = self._worker.run(lambda mapper: (mapper.gaussians(), self._worker.revision()))
                change_log.update(*copied.result())
            batch = change_log.since(since_revision)
            cropped = batch if region is None else crop_to_box(batch, region, grid)
            encode = partial(encode_parts, grid=grid, sender=self._agent_id)
            key = request.roi_only, region, since_revision
            return AgentMapReader(change_log.revision, cropped, key, encode, self._encoded_parts)

        async def read(since_revision: int) -> AgentMapReader:
            return await self._comparing.run(context, read_changes, since_revision)

        work = partial(self._encoding.run, context)
        blocks = follow(read, self._worker.revision, request.since_revision, self._changes, work)
        async for block in blocks:
            yield pb.WatchMapResponse(block=block)

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
            frame = await asyncio.get_running_loop().run_in_executor(self._decoder, _decode_frame, request)
            return asyncio.wrap_future(self._mission.submit(frame))
        except InvalidInputError as error:
            rejected: asyncio.Future[FrameReport] = asyncio.get_running_loop().create_future()
            rejected.set_result(self._worker.reject(request.frame.index, str(error)))
            return rejected


def _decode_frame(request: pb.IngestFramesRequest) -> Frame:
    """Return the frame without lens distortion and rolling shutter. Raises InvalidInputError and subclasses."""
    return open_calibrator().live_frame(*live_frame_from_message(request.frame))
