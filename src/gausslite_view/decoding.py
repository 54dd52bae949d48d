"""What the pages show of an agent's camera and of the server's keyframes, from the answers of both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.relevance import CameraView, DetectedBox, DetectedImage
from gausslite.wire import convert
from gausslite.wire.views import MAX_BOXES, MAX_KEYFRAMES, MAX_POSES


@dataclass(frozen=True, slots=True, eq=False)
class StoredKeyframe:
    """A keyframe with its frame index. T_world_camera: in the fused map's frame, None if the agent's does not fit.

    indices: of all keyframes that the server has of the agent, the newest last. roi: True in the task's region, None if
    the agent did not send it.
    """

    index: int
    capture_time_ns: int
    rgb: UInt8[ndarray, "h w 3"]
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"] | None
    indices: tuple[int, ...]
    roi: Bool[ndarray, "h w"] | None = None


def camera_view_from_message(message: Any) -> CameraView | None:
    """Decode a view; None for an agent without keyframes. Raises InvalidInputError, PoseError."""
    if not message.colour_jpeg:
        return None
    camera = convert.camera_from_message(message.camera)
    return CameraView(
        rgb=convert.decode_colour(message.colour_jpeg, camera.width_px, camera.height_px),
        roi=convert.decode_mask(message.region_png, camera.width_px, camera.height_px),
        camera=camera,
        frame_index=message.frame_index,
        T_world_camera=convert.transform_from_message("camera view t_world_camera", message.t_world_camera),
        times_ns=np.array([view_pose.capture_time_ns for view_pose in message.path], np.int64),
        path=_poses("path", [view_pose.t_world_camera for view_pose in message.path], MAX_POSES),
        keyframes=_poses("keyframes", list(message.keyframes), MAX_KEYFRAMES),
        detected=_detected_from_message(message.detected) if message.HasField("detected") else None,
    )


def stored_keyframe_from_message(message: Any) -> StoredKeyframe | None:
    """Decode a keyframe; None if the server has none of the agent. Raises InvalidInputError, PoseError."""
    if not message.colour:
        return None
    camera, pose = convert.camera_from_message(message.camera), None
    if message.HasField("t_world_camera"):
        pose = convert.transform_from_message("keyframe t_world_camera", message.t_world_camera)
    return StoredKeyframe(
        index=message.index,
        capture_time_ns=message.capture_time_ns,
        rgb=convert.decode_colour(message.colour, camera.width_px, camera.height_px),
        camera=camera,
        T_world_camera=pose,
        indices=tuple(message.indices),
        roi=convert.decode_region(message.region_png, camera),
    )


def _detected_from_message(message: Any) -> DetectedImage:
    if not 0 < message.width_px * message.height_px <= convert.MAX_IMAGE_PX:
        size = f"{message.width_px}x{message.height_px}"
        raise InvalidInputError(f"detected image: expected 1 to {convert.MAX_IMAGE_PX} pixels, got {size}")
    if len(message.boxes) > MAX_BOXES:
        raise InvalidInputError(f"detected boxes: expected at most {MAX_BOXES}, got {len(message.boxes)}")
    boxes = []
    for box in message.boxes:
        require_name("detected phrase", box.phrase)
        box_px = box.left_px, box.top_px, box.right_px, box.bottom_px
        if not all(math.isfinite(value) for value in (*box_px, box.score)):
            raise InvalidInputError("detected boxes: expected finite numbers, got others")
        boxes.append(DetectedBox(box.phrase, box.score, box_px, is_weak=box.is_weak))
    rgb = convert.decode_colour(message.colour_jpeg, message.width_px, message.height_px)
    return DetectedImage(message.frame_index, rgb, tuple(boxes))


def _poses(name: str, messages: list[Any], highest: int) -> Float64[ndarray, "n 4 4"]:
    if len(messages) > highest:
        raise InvalidInputError(f"camera view {name}: expected at most {highest} poses, got {len(messages)}")
    poses = [convert.transform_from_message(f"camera view {name}", message) for message in messages]
    return np.array(poses, np.float64).reshape(-1, 4, 4)
