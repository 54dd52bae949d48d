"""Convert a mission's figures, layers, frames and views to messages, and keyframes and exports from them."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator
from dataclasses import replace

import google_crc32c
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.ply import ply_bytes
from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.frame import MAX_COORDINATE_M
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState, FrameAlignment
from gausslite.fusion.fused_map import MapLayer
from gausslite.fusion.keyframe_pool import AgentKeyframe, EncodedKeyframe
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS, SessionRecord
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.traffic import AgentContribution, TrafficCounters
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.geometry_pb2 import EncodedFrame
from gausslite.wire import convert
from gausslite.wire.map_changes import read_deadline
from gausslite.wire.security import Caller

_MAX_SELECTED_KEYFRAMES = 10_000
_CHUNK_BYTES = 1 << 20
_STATES = {
    state: pb.AlignmentState.Value(f"ALIGNMENT_STATE_{state.name.replace('UNKNOWN', 'UNSPECIFIED')}")
    for state in AlignmentState
}
_LAYERS: dict[int, MapLayer] = {
    0: MapLayer.VOTE,
    **{pb.MapLayer.Value(f"MAP_LAYER_{layer.name}"): layer for layer in MapLayer},
}
_CONTRIBUTION = (
    *("agent_id", "joined", "last_update_seq", "keyframes", "targets"),
    *("voxels", "gaussians", "kappa_sum", "won_voxels"),
)


def session_of(engine: FusionEngine, session_id: str, caller: Caller) -> SessionRecord:
    """Return a session. Raises SessionUnknownError, NotPermittedError if the caller is another robot."""
    session = engine.members.sessions.get(session_id)
    caller.require_agent(session.agent_id)
    return session


def kept_session(engine: FusionEngine, request: pb.KeepSessionRequest, caller: Caller) -> pb.KeepSessionResponse:
    """Renew the lease of a session; return what identifies the stored updates. Raises as `session_of`."""
    agent_id = session_of(engine, request.session_id, caller).agent_id
    engine.traffic.record(agent_id, TrafficCounters(localisation=request.localisation))
    return pb.KeepSessionResponse(
        highest_update_seq=engine.store.totals(agent_id).highest_update_seq,
        incarnation_id=engine.store.incarnation_id,
        alignment=alignment_to_message(engine.frames.get(agent_id)),
    )


def store_keyframe(engine: FusionEngine, request: pb.ContributeKeyframesRequest, caller: Caller) -> None:
    """Store a keyframe as it was received. Raises InvalidInputError, QuotaError, SessionUnknownError."""
    agent_id = session_of(engine, request.session_id, caller).agent_id
    message = request.keyframe
    if not request.HasField("keyframe"):
        raise InvalidInputError("keyframe: expected one, got none")
    # before any image is decoded: its header must then state the camera's size
    pixels = message.camera.width_px * message.camera.height_px
    engine.settings.quotas.require_keyframe(message.index, pixels, message.ByteSize())
    # decoded here to refuse invalid images; stored as received, which needs less space
    frame = convert.frame_from_message(message)
    convert.decode_region(message.region_png, frame.camera)
    data = message.SerializeToString()
    keyframe = EncodedKeyframe(agent_id, frame.index, frame.capture_time_ns, frame.depth_m.size, data)
    engine.keyframes.add(keyframe, request.selected[:_MAX_SELECTED_KEYFRAMES], request.session_id)


def refine_settings(default: RefineSettings, request: pb.RefineFusedMapRequest) -> RefineSettings:
    """Return the settings of a refinement: those of the server where the request states none. Raises QuotaError."""
    if request.iterations > MAX_REFINE_ITERATIONS:
        raise QuotaError(f"refine iterations: expected at most {MAX_REFINE_ITERATIONS}, got {request.iterations}")
    return replace(
        default,
        iterations=request.iterations or default.iterations,
        max_gaussians=min(request.max_gaussians or default.max_gaussians, default.max_gaussians),
        seed=request.seed,
    )


def select_map(engine: FusionEngine, request: pb.ExportFusedMapRequest) -> VoxelBatch:
    """Return the map that a request names. Raises InvalidInputError, MismatchError, RevisionGoneError."""
    match request.strategy:
        case pb.FUSION_STRATEGY_VOTE:
            return engine.maps.voted_map(request.agent_id)
        case pb.FUSION_STRATEGY_CONCATENATION:
            return engine.maps.union_map(request.agent_id)
        case pb.FUSION_STRATEGY_REFINED if not request.agent_id:
            return engine.maps.refined_map()
        case pb.FUSION_STRATEGY_REFINED:
            raise InvalidInputError("agent_id: expected none with REFINED, whose Gaussians belong to everyone")
        case other:
            raise InvalidInputError(f"strategy: expected VOTE, CONCATENATION or REFINED, got {other}")


class ExportedFile:
    """A file that is sent, as a copy on the disk: a slow reader must not hold it in memory."""

    def __init__(self, batch: VoxelBatch, world_frame: str) -> None:
        """Encode a map as PLY; world_frame: see MissionConfig.given_world_frame."""
        data = ply_bytes(batch.gaussians, world_frame)
        self._size_bytes, self._crc32c = len(data), google_crc32c.value(data)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `chunks`
        self._file.write(data)
        self._file.seek(0)

    async def chunks(self) -> AsyncIterator[pb.ExportFusedMapResponse]:
        """Yield the file in messages, once."""
        offset = 0
        with self._file:
            while data := await asyncio.to_thread(self._file.read, _CHUNK_BYTES):
                with read_deadline():
                    yield pb.ExportFusedMapResponse(
                        offset=offset, total_bytes=self._size_bytes, data=data, crc32c=self._crc32c
                    )
                offset += len(data)


def read_keyframe(engine: FusionEngine, request: pb.GetKeyframeRequest) -> pb.GetKeyframeResponse:
    """Return a keyframe without its depth; empty if the agent has none. Raises InvalidInputError, StorageError."""
    index = request.index if request.HasField("index") else None
    data, indices = engine.keyframes.find(request.agent_id, index), engine.keyframes.indices(request.agent_id)
    if not data:
        return pb.GetKeyframeResponse()
    message = EncodedFrame.FromString(data)
    in_fused_frame = engine.in_fused_frame([AgentKeyframe(request.agent_id, convert.decode_frame(data))])
    return pb.GetKeyframeResponse(
        **convert.values_of(message, ("index", "capture_time_ns", "colour", "camera", "region_png")),
        t_world_camera=convert.transform_to_message(in_fused_frame[0].frame.T_world_camera) if in_fused_frame else None,
        indices=indices,
    )


def layer_from_message(number: int) -> MapLayer:
    """Decode a layer of the map. Raises InvalidInputError."""
    if number not in _LAYERS:
        raise InvalidInputError(f"layer: expected VOTE or REFINED, got {number}")
    return _LAYERS[number]


def declare_frame(engine: FusionEngine, request: pb.JoinSessionRequest) -> None:
    """Set what an agent says of its frame. Raises PoseError, InvalidInputError, StorageError."""
    T_fused_agent = declared_frame_from_message(request)
    if T_fused_agent is None and not request.frame_is_unknown and engine.frames.get(request.agent_id).is_unknown:
        T_fused_agent = np.eye(4)  # it knows its frame now
    if T_fused_agent is not None or request.frame_is_unknown:
        engine.declare_frame(request.agent_id, T_fused_agent)


def declared_frame_from_message(request: pb.JoinSessionRequest) -> Float64[ndarray, "4 4"] | None:
    """Decode T_fused_agent, None if the agent does not declare it. Raises PoseError, InvalidInputError."""
    if not request.HasField("t_fused_agent"):
        return None
    if request.frame_is_unknown:
        raise InvalidInputError("t_fused_agent: expected none of an unknown frame, got one")
    T_fused_agent = convert.transform_from_message("t_fused_agent", request.t_fused_agent)
    if np.abs(T_fused_agent[:3, 3]).max() > MAX_COORDINATE_M:
        raise InvalidInputError(
            f"t_fused_agent: expected a translation within {MAX_COORDINATE_M:g} m, got {T_fused_agent[:3, 3].tolist()}"
        )
    return T_fused_agent


def alignment_to_message(alignment: FrameAlignment) -> pb.FrameAlignment:
    """Encode how an agent's frame fits the fused map."""
    message = pb.FrameAlignment(
        state=_STATES[alignment.state],
        t_fused_agent=convert.transform_to_message(alignment.T_fused_agent),
        message=alignment.message,
    )
    fit = alignment.fit
    if fit is not None:
        message.residual_before_m, message.residual_after_m = fit.before.distance_m, fit.after.distance_m
        message.colour_before, message.colour_after = fit.before.colour, fit.after.colour
        message.compared = fit.compared
    return message


def contribution_to_message(agent: AgentContribution) -> pb.AgentContribution:
    """Encode the figures of one agent."""
    return pb.AgentContribution(
        **convert.values_of(agent, _CONTRIBUTION),
        **agent.traffic._asdict(),
        alignment=alignment_to_message(agent.alignment),
    )
