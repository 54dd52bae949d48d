"""Read a stored keyframe for a person: the colour image and the camera's pose in the fused map's frame."""

from __future__ import annotations

from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.geometry_pb2 import EncodedFrame
from gausslite.wire.convert import decode_frame, transform_to_message


def read_keyframe(engine: FusionEngine, request: pb.GetKeyframeRequest) -> pb.GetKeyframeResponse:
    """Return a keyframe without its depth; empty if the agent has none. Raises InvalidInputError, StorageError."""
    index = request.index if request.HasField("index") else None
    data, indices = engine.encoded_keyframe(request.agent_id, index)
    if not data:
        return pb.GetKeyframeResponse()
    message = EncodedFrame.FromString(data)
    in_fused_frame = engine.in_fused_frame([AgentKeyframe(request.agent_id, decode_frame(data))])
    return pb.GetKeyframeResponse(
        index=message.index,
        capture_time_ns=message.capture_time_ns,
        colour=message.colour,
        camera=message.camera,
        t_world_camera=transform_to_message(in_fused_frame[0].frame.T_world_camera) if in_fused_frame else None,
        indices=indices,
        region_png=message.region_png,
    )
