"""Clients of the three services: domain objects as arguments and results, GaussLite errors, deadlines on unary calls.

Clients are thread-safe. Streams are iterators; closing one cancels the call.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import google_crc32c
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from gausslite.codec.subset_codec import CodecLimits
from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.source import capped_size
from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_types
from gausslite.domain.errors import ChecksumError, CodecError, GaussLiteError, UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.objects import ObjectReport, TeamObject
from gausslite.domain.relevance import PointedObject, PointM
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.v1 import agent_service_pb2 as agent_pb
from gausslite.v1 import agent_service_pb2_grpc as agent_pb_grpc
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.v1 import geometry_pb2, parser_service_pb2, parser_service_pb2_grpc
from gausslite.wire import convert, convert_task
from gausslite.wire.channel import DEADLINE_S, MAX_MESSAGE_BYTES, ServiceChannel, require_serving
from gausslite.wire.convert import decode_colour, decode_depth, digests_from_messages
from gausslite.wire.convert_task import report_to_message, team_object_from_message
from gausslite.wire.security import Tls

MAX_END_S = 90_000.0
"""Longer than any agent takes to end a mission: its drain-timeout is at most a day."""
_FOLLOW_INTERVAL_S, _UNREACHABLE_S = 5.0, 60.0
"""Shortest times until a client looks for the owner of its subsets again."""
# larger than the default, because a server may send larger blocks
_WATCH_LIMITS = CodecLimits(max_bytes=MAX_MESSAGE_BYTES, max_voxels=2_000_000, max_gaussians=2_000_000)

_MAX_FRAME_BYTES, _MAX_SENT_PX = MAX_MESSAGE_BYTES - (1 << 12), round(0.99 * convert.MAX_IMAGE_PX)
_log = logging.getLogger(__name__)

FrameOutcome = agent_pb.FrameOutcome
"""Names the outcomes of `AgentClient.ingest`: `FrameOutcome.Name(result.outcome)`."""
Session = pb.JoinSessionResponse
"""The fusion server's answer to a joining agent."""
_View = tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]
UNKNOWN: Final = "unknown"


@dataclass(frozen=True, slots=True)
class Export:
    """The map to download: `vote`, `concatenation` or `refined`; with an agent's id only its contribution."""

    strategy: str = "vote"  # the layer
    agent_id: str = ""


def _decode_view(response: Any, camera: Camera) -> _View:
    size = camera.width_px, camera.height_px
    return decode_colour(response.colour_png, *size), decode_depth(response.depth_png, *size)


def _decode_updates(responses: Iterator[Any]) -> Iterator[convert.MapUpdate]:
    first = True
    for response in responses:
        yield (update := convert.map_update_from_message(response.block, _WATCH_LIMITS, first))
        first = update.last


class ParserClient(ServiceChannel):
    """The parser service as a task.TaskParser."""

    kind = "parser"

    def __init__(self, address: str, deadline_s: float = DEADLINE_S, tls: Tls | None = None) -> None:
        super().__init__(address, deadline_s, tls)
        self._stub = parser_service_pb2_grpc.ParserServiceStub(self._channel)

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of a task. Raises TaskError, InvalidInputError, UnavailableError."""
        require_types(text=(text, str))
        request = parser_service_pb2.ParseTaskRequest(text=text)
        return convert_task.graph_from_message(self._call(self._stub.ParseTask, request).graph)


class AgentClient(ServiceChannel):
    """One agent."""

    kind = "agent"

    def __init__(self, address: str, deadline_s: float = DEADLINE_S, tls: Tls | None = None) -> None:
        super().__init__(address, deadline_s, tls)
        self._stub = agent_pb_grpc.AgentServiceStub(self._channel)

    def assign_task(
        self,
        task: str | TaskGraph | None = None,
        pointed: Sequence[PointedObject] = (),
        excluded_m: Sequence[PointM] = (),
    ) -> TaskGraph:
        """Assign a task as text or graph; returns the graph of the current task.

        pointed: its objects that a person points at; excluded_m: points on objects that are not meant. With these
        alone, the current task stays. Raises TaskError, InvalidInputError, UnavailableError.
        """
        request = convert_task.assigned_to_message(task, pointed, excluded_m)
        return convert_task.graph_from_message(self._call(self._stub.AssignTask, request).graph)

    def ingest(
        self, frames: Iterable[Frame], lossless: bool = False, lens: Lens | None = None
    ) -> Iterator[agent_pb.IngestFramesResponse]:
        """Send frames; yields one outcome for each, in order.

        lens: distortion of the frames' images, which the agent corrects together with the rolling shutter that
        `Frame.motion` states. Frames of more pixels or bytes than a message holds are made smaller.
        """
        requests = (agent_pb.IngestFramesRequest(frame=_fitting_message(frame, lossless, lens)) for frame in frames)
        return self._exchange(self._stub.IngestFrames, requests)

    def end_mission(self, handover: bool | None = None, drain_s: float | None = None) -> agent_pb.EndMissionResponse:
        """End the mission; return what was sent and left. None: as the agent's options. Raises MismatchError."""
        request = agent_pb.EndMissionRequest(handover=handover, drain_seconds=drain_s)
        # after sending, the agent also writes its results
        deadline_s = MAX_END_S if drain_s is None else drain_s + 10 * self._deadline_s
        return self._call(self._stub.EndMission, request, deadline_s)

    def status(self) -> agent_pb.GetAgentStatusResponse:
        """Return the agent's status and counters."""
        return self._call(self._stub.GetAgentStatus, agent_pb.GetAgentStatusRequest())

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> _View:
        """Return colour and depth in metres of the agent's map, rendered from this pose."""
        request = agent_pb.RenderViewRequest(
            camera=convert.camera_to_message(camera), t_world_camera=convert.transform_to_message(T_world_camera)
        )
        return _decode_view(self._call(self._stub.RenderView, request), camera)

    def camera_view(self) -> agent_pb.GetCameraViewResponse:
        """Return the newest keyframe with its region and the camera's path; empty before the first keyframe."""
        return self._call(self._stub.GetCameraView, agent_pb.GetCameraViewRequest())

    def watch_map(
        self, since_revision: int = 0, region: AxisAlignedBox | None = None, roi_only: bool = False
    ) -> Iterator[convert.MapUpdate]:
        """Yield the map and its later changes, without end. Raises RevisionGoneError if since_revision is too old."""
        request = agent_pb.WatchMapRequest(
            since_revision=since_revision,
            region=None if region is None else convert.box_to_message(region),
            roi_only=roi_only,
        )
        yield from _decode_updates(self._stream(self._stub.WatchMap, request))


def _fitting_message(frame: Frame, lossless: bool, lens: Lens | None) -> geometry_pb2.EncodedFrame:
    """Return the frame's message, of a smaller image if it exceeds what the agent accepts."""
    require_types(frame=(frame, Frame))
    recorded, pixels = RgbdImage(frame.rgb, frame.depth_m, frame.camera), _MAX_SENT_PX
    while True:
        image = resize_rgbd(recorded, capped_size(frame.camera, pixels))
        message = convert.frame_to_message(image.in_frame(frame), lossless, lens=lens)
        if message.ByteSize() < _MAX_FRAME_BYTES:
            break
        pixels = image.depth_m.size // 2
    if image.camera != frame.camera:
        size = f"{image.camera.width_px}x{image.camera.height_px}"
        _log.warning("frame %d: the image is made smaller, to %s, so that a message holds it", frame.index, size)
    return message


def is_done(status: agent_pb.GetAgentStatusResponse) -> bool:
    """True after the agent has ended its mission and written its results."""
    return status.state == agent_pb.AGENT_STATE_ENDED


class FusionClient(ServiceChannel):
    """The fusion server."""

    kind = "fusion server"

    def __init__(
        self,
        address: str,
        deadline_s: float = DEADLINE_S,
        mission_id: str = "",
        tls: Tls | None = None,
        token: str | None = None,
    ) -> None:
        """token: the robot's secret in all its joins, for the lease of its name; by default one of this client."""
        super().__init__(address, deadline_s, tls)
        self.mission_id = mission_id
        self._token = secrets.token_hex(16) if token is None else token
        self._stub = pb_grpc.FusionServiceStub(self._channel)
        self._owner: FusionClient | None = None
        self._next_owner, self._next_follow_s = "", 0.0

    def join(
        self,
        agent_id: str,
        grid: VoxelGrid,
        world_frame: str = "",
        fresh_map: bool = False,
        task: TaskGraph | None = None,
        T_fused_agent: Float64[ndarray, "4 4"] | Literal["unknown"] | None = None,
    ) -> Session:
        """Join the mission; T_fused_agent declares the pose of the agent's frame in the fused map's.

        None: the same frame. "unknown": the agent's map stays out of the fused one until the server has found its pose.

        Raises MismatchError if the grid, the world frame or the mission differ, NameInUseError while another robot
        holds the name's lease, NotPermittedError for a banned agent.
        """
        request = pb.JoinSessionRequest(
            agent_id=agent_id,
            mission_id=self.mission_id,
            grid=geometry_pb2.VoxelGrid(size_m=grid.size_m),
            world_frame=world_frame,
            fresh_map=fresh_map,
            task=None if task is None else convert_task.graph_to_message(task),
            t_fused_agent=convert.transform_to_message(T_fused_agent) if isinstance(T_fused_agent, ndarray) else None,
            token=self._token,
            frame_is_unknown=isinstance(T_fused_agent, str),
        )
        return self._call(self._stub.JoinSession, request)

    def keep_session(self, session_id: str, localisation: str = "unspecified") -> pb.KeepSessionResponse:
        """Renew the lease; return what identifies the updates that the server has. Raises SessionUnknownError.

        localisation: of the robot; "tracked", "doubtful" or "lost".
        """
        if self._owner is not None:
            try:
                # it knows the latest subsets
                return self._owner.keep_session(session_id, localisation)
            except UnavailableError:
                self._leave_owner()
        number = geometry_pb2.Localisation.Value(f"LOCALISATION_{localisation.upper()}")
        request = pb.KeepSessionRequest(session_id=session_id, localisation=number)
        return self._call(self._stub.KeepSession, request)

    def stored_digests(self, session_id: str) -> TileDigests:
        """Return the digests of the updates that the server has of the session's agent."""
        request = pb.GetUpdateDigestsRequest(session_id=session_id)
        return digests_from_messages(self._stream(self._stub.GetUpdateDigests, request, self._deadline_s))

    def contribute(
        self, requests: Sequence[pb.ContributeSubsetsRequest], deadline_s: float
    ) -> Iterator[pb.ContributeSubsetsResponse]:
        """Send these subsets; yields the acknowledgements until all have arrived or `deadline_s` has passed.

        Where several servers share the mission, later subsets go to the owner of these, if it can be reached.
        """
        self._follow(self._next_owner)
        if self._owner is not None:
            answered: set[int] = set()
            try:
                for response in self._send(self._owner, requests, deadline_s):
                    answered.update(outcome.sequence for outcome in response.outcomes)
                    yield response
                return
            except UnavailableError:
                # any server takes the others
                self._leave_owner()
                requests = [request for request in requests if request.sequence not in answered]
        yield from self._send(self, requests, deadline_s)

    def _send(
        self, server: FusionClient, requests: Sequence[pb.ContributeSubsetsRequest], deadline_s: float
    ) -> Iterator[pb.ContributeSubsetsResponse]:
        for response in server._exchange(server._stub.ContributeSubsets, requests, deadline_s):
            self._next_owner = response.outcomes[-1].owner if response.outcomes else self._next_owner
            yield response

    def _follow(self, owner: str) -> None:
        now_s = time.monotonic()
        if not owner or now_s < self._next_follow_s or self._closed:
            return
        self._leave_owner()
        try:
            require_serving(owner, self._tls)
            self._owner = FusionClient(owner, self._deadline_s, self.mission_id, self._tls)
            self._next_follow_s = now_s + _FOLLOW_INTERVAL_S
        except GaussLiteError:
            # servers may reach each other where robots do not
            self._next_follow_s = now_s + _UNREACHABLE_S

    def _leave_owner(self) -> None:
        owner, self._owner = self._owner, None
        if owner is not None:
            owner.close()

    def close(self) -> None:
        """Close the channels and cancel their calls."""
        super().close()
        self._leave_owner()

    def contribute_keyframes(self, session_id: str, keyframes: Iterable[Frame]) -> int:
        """Send keyframes for the refinement; returns the number stored. Raises QuotaError, SessionUnknownError."""
        return self.contribute_encoded_keyframes(session_id, map(convert.frame_to_message, keyframes)).accepted

    def contribute_encoded_keyframes(
        self,
        session_id: str,
        keyframes: Iterable[geometry_pb2.EncodedFrame],
        selected: Sequence[int] = (),
        deadline_s: float | None = None,
    ) -> pb.ContributeKeyframesResponse:
        """Send encoded keyframes; the server keeps only the `selected` others, if any. Raises QuotaError."""
        requests = (
            pb.ContributeKeyframesRequest(session_id=session_id, keyframe=keyframe, selected=selected)
            for keyframe in keyframes
        )
        return self._call(self._stub.ContributeKeyframes, requests, deadline_s or 10 * self._deadline_s)

    def watch(
        self,
        since_revision: int = 0,
        region: AxisAlignedBox | None = None,
        layer: str = "vote",
        exclude_agent: str = "",
    ) -> Iterator[convert.MapUpdate]:
        """Yield a layer of the map (vote, refined) and its changes, without end; exclude_agent: without its voxels.

        Raises RevisionGoneError if since_revision is gone.
        """
        request = pb.WatchFusedMapRequest(
            mission_id=self.mission_id,
            since_revision=since_revision,
            region=None if region is None else convert.box_to_message(region),
            layer=pb.MapLayer.Value(f"MAP_LAYER_{layer.upper()}"),
            exclude_agent_id=exclude_agent,
        )
        yield from _decode_updates(self._stream(self._stub.WatchFusedMap, request))

    def refine(self, iterations: int = 0, max_gaussians: int = 0, seed: int = 0) -> Iterator[pb.RefineFusedMapResponse]:
        """Refine the fused map on all agents' keyframes; yields progress; closing the iterator cancels."""
        request = pb.RefineFusedMapRequest(
            mission_id=self.mission_id, iterations=iterations, max_gaussians=max_gaussians, seed=seed
        )
        return self._stream(self._stub.RefineFusedMap, request)

    def export(self, export: Export) -> bytes:
        """Return a map as the bytes of a PLY file. Raises MismatchError before the first refinement, ChecksumError."""
        request = pb.ExportFusedMapRequest(
            mission_id=self.mission_id,
            strategy=pb.FusionStrategy.Value(f"FUSION_STRATEGY_{export.strategy.upper()}"),
            agent_id=export.agent_id,
        )
        data, last = bytearray(), None
        for last in self._stream(self._stub.ExportFusedMap, request):
            if last.offset != len(data):
                raise CodecError(f"export: expected the chunk at byte {len(data)}, got the one at {last.offset}")
            data += last.data
        if last is None or last.total_bytes != len(data):
            raise CodecError(f"export: the stream ended after {len(data)} bytes, before the map was complete")
        if google_crc32c.value(bytes(data)) != last.crc32c:
            raise ChecksumError("export: CRC32C does not match; the map was damaged in transit")
        return bytes(data)

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], layer: str = "vote") -> _View:
        """Return colour and depth in metres of a layer of the map (vote, refined), rendered from this pose."""
        request = pb.RenderFusedViewRequest(
            mission_id=self.mission_id,
            camera=convert.camera_to_message(camera),
            t_world_camera=convert.transform_to_message(T_world_camera),
            layer=pb.MapLayer.Value(f"MAP_LAYER_{layer.upper()}"),
        )
        return _decode_view(self._call(self._stub.RenderView, request), camera)

    def report_objects(self, session_id: str, report: ObjectReport) -> int:
        """Replace the agent's task graph and objects; returns the bytes sent. Raises SessionUnknownError."""
        request = report_to_message(session_id, report)
        self._call(self._stub.ReportObjects, request)
        return request.ByteSize()

    def query_objects(self, noun: str = "") -> tuple[TeamObject, ...]:
        """Return the team's objects that a noun names, or all, the most confident first."""
        require_types(noun=(noun, str))
        request = pb.QueryObjectsRequest(mission_id=self.mission_id, noun=noun)
        return tuple(map(team_object_from_message, self._call(self._stub.QueryObjects, request).objects))

    def keyframe(self, agent_id: str, index: int | None = None) -> pb.GetKeyframeResponse:
        """Return the keyframe of this index, else the newest; empty without any. Raises InvalidInputError."""
        request = pb.GetKeyframeRequest(mission_id=self.mission_id, agent_id=agent_id, index=index)
        return self._call(self._stub.GetKeyframe, request)

    def status(self) -> pb.GetSessionStatusResponse:
        """Return the figures of the mission and of each agent."""
        request = pb.GetSessionStatusRequest(mission_id=self.mission_id)
        return self._call(self._stub.GetSessionStatus, request)

    def unlocalised(self) -> dict[str, str]:
        """Return the agents whose frame nobody knows, with what the server says of it; their objects are left out."""
        state = pb.ALIGNMENT_STATE_UNLOCALISED
        return {
            agent.agent_id: agent.alignment.message for agent in self.status().agents if agent.alignment.state == state
        }

    def evict(self, agent_id: str, ban: bool = False) -> int:
        """End an agent's session and delete its data; `ban` refuses its later joins. Returns the number of its voxels.

        Raises NotPermittedError unless the caller is an operator, InvalidInputError for an unknown agent.
        """
        request = pb.EvictAgentRequest(mission_id=self.mission_id, agent_id=agent_id, ban=ban)
        return self._call(self._stub.EvictAgent, request).voxels

    def unban(self, agent_id: str) -> None:
        """Let a banned agent join again. Raises NotPermittedError, InvalidInputError if it is not banned."""
        request = pb.UnbanAgentRequest(mission_id=self.mission_id, agent_id=agent_id)
        self._call(self._stub.UnbanAgent, request)

    def leave(self, session_id: str, forget: bool = False) -> int:
        """Leave the mission; with `forget` the server deletes the agent's updates. Returns the fused revision."""
        request = pb.LeaveSessionRequest(session_id=session_id, forget=forget)
        return self._call(self._stub.LeaveSession, request).fused_revision
