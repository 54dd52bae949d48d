"""A keyframe that the fusion server has of an agent, for a person: image, camera and pose, as a message."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.convert import camera_from_message, transform_from_message
from gausslite.wire.images import decode_colour, decode_mask


@dataclass(frozen=True, slots=True, eq=False)
class StoredKeyframe:
    """A keyframe with its frame index. T_world_camera: in the fused map's frame, None if the agent's does not fit.

    indices: of all keyframes that the server has of the agent, ascending. roi: True in the task's region, None if the
    agent did not send it.
    """

    index: int
    capture_time_ns: int
    rgb: UInt8[ndarray, "h w 3"]
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"] | None
    indices: tuple[int, ...]
    roi: Bool[ndarray, "h w"] | None = None


def region_from_png(data: bytes, camera: Camera) -> Bool[ndarray, "h w"] | None:
    """Decode the region of a keyframe; None for empty bytes. Raises InvalidInputError."""
    return decode_mask(data, camera.width_px, camera.height_px) if data else None


def stored_keyframe_from_message(message: pb.GetKeyframeResponse) -> StoredKeyframe | None:
    """Decode a keyframe; None if the server has none of the agent. Raises InvalidInputError, PoseError."""
    if not message.colour:
        return None
    camera = camera_from_message(message.camera)
    has_pose = message.HasField("t_world_camera")
    return StoredKeyframe(
        index=message.index,
        capture_time_ns=message.capture_time_ns,
        rgb=decode_colour(message.colour, camera.width_px, camera.height_px),
        camera=camera,
        T_world_camera=transform_from_message("keyframe t_world_camera", message.t_world_camera) if has_pose else None,
        indices=tuple(message.indices),
        roi=region_from_png(message.region_png, camera),
    )
