"""The view of an agent's camera as a message, and what wakes the watchers of a map."""

from __future__ import annotations

import asyncio

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import QuotaError
from gausslite.domain.relevance import CameraView, DetectedImage
from gausslite.render.rasterizer import Rendering
from gausslite.v1 import agent_service_pb2 as agent_pb
from gausslite.v1 import geometry_pb2
from gausslite.wire import convert

MAX_POSES, MAX_KEYFRAMES, MAX_BOXES = 1000, 60, 100
_MAX_VIEW_PX = 1920 * 1080
MAX_VIEWS_WAITING = 16
_SIDES = ("left_px", "top_px", "right_px", "bottom_px")
_NOTIFY_PAUSE_S = 0.1
_SUBSCRIPTION_PAUSE_S = 0.005
"""Serving a watcher takes about a millisecond, and it subscribes twice for each change."""


def view_camera_from_message(message: geometry_pb2.Camera) -> Camera:
    """Decode the camera of a view to render. Raises QuotaError above two megapixels, InvalidInputError."""
    camera = convert.camera_from_message(message)
    pixels = camera.width_px * camera.height_px
    if pixels > _MAX_VIEW_PX:
        raise QuotaError(f"view: expected at most {_MAX_VIEW_PX} pixels, got {pixels}")
    return camera


def view_to_pngs(camera: Camera, rendering: Rendering | None) -> dict[str, bytes]:
    """Encode a view as the fields of its message; None, of an empty map, is black without depth."""
    size = camera.height_px, camera.width_px
    rgb, depth_m = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
    if rendering is not None:
        rgb, depth_m = rendering.rgb, rendering.expected_depth_m()
    rgb_8 = np.rint(np.clip(rgb, 0.0, 1.0) * 255).astype(np.uint8)
    return {"colour_png": convert.encode_colour(rgb_8, lossless=True), "depth_png": convert.encode_depth(depth_m)}


def camera_view_to_message(view: CameraView | None) -> agent_pb.GetCameraViewResponse:
    """Encode a view with a JPEG; long paths are thinned evenly. An agent without keyframes has an empty view."""
    if view is None:
        return agent_pb.GetCameraViewResponse()
    return agent_pb.GetCameraViewResponse(
        colour_jpeg=convert.encode_colour(view.rgb),
        region_png=convert.encode_mask(view.roi),
        camera=convert.camera_to_message(view.camera),
        frame_index=view.frame_index,
        t_world_camera=convert.transform_to_message(view.T_world_camera),
        path=[
            agent_pb.StampedPose(
                capture_time_ns=int(view.times_ns[i]), t_world_camera=convert.transform_to_message(view.path[i])
            )
            for i in _evenly(len(view.path), MAX_POSES)
        ],
        keyframes=[
            convert.transform_to_message(view.keyframes[i]) for i in _evenly(len(view.keyframes), MAX_KEYFRAMES)
        ],
        detected=None if view.detected is None else _detected_to_message(view.detected),
    )


def _detected_to_message(detected: DetectedImage) -> agent_pb.DetectedImage:
    height_px, width_px = detected.rgb.shape[:2]
    boxes = sorted(detected.boxes, key=lambda box: -box.score)[:MAX_BOXES]
    return agent_pb.DetectedImage(
        frame_index=detected.index,
        colour_jpeg=convert.encode_colour(detected.rgb),
        width_px=width_px,
        height_px=height_px,
        boxes=[
            agent_pb.DetectedBox(
                phrase=box.phrase, score=box.score, is_weak=box.is_weak, **dict(zip(_SIDES, box.box_px, strict=True))
            )
            for box in boxes
        ],
    )


def _evenly(count: int, highest: int) -> Int64[ndarray, " n"]:
    """Return the positions of at most this many of `count` values, evenly spaced, with the first and the last."""
    positions: Int64[ndarray, " n"] = np.unique(np.linspace(0, max(count - 1, 0), min(count, highest)).astype(np.int64))
    return positions


class ChangeNotifier:
    """Subscribe, read the state, then wait on the subscription: so no change is missed. Use it on the event loop.

    Subscribers wake together, at most every _NOTIFY_PAUSE_S and less often if they are many, so that they read the
    same changes and leave most of the time to others.
    """

    def __init__(self) -> None:
        self._next_change = asyncio.Event()
        self._earliest_s = 0.0
        self._subscriptions = 0
        self._is_due = False

    def subscribe(self) -> asyncio.Event:
        """Return an event that the next `notify` sets."""
        self._subscriptions += 1
        return self._next_change

    def notify(self) -> None:
        """Wake all subscribers, now or soon."""
        if not self._is_due:
            self._is_due = True
            loop = asyncio.get_running_loop()
            loop.call_at(max(self._earliest_s, loop.time()), self._wake)

    def _wake(self) -> None:
        self._is_due = False
        pause_s = max(_NOTIFY_PAUSE_S, _SUBSCRIPTION_PAUSE_S * self._subscriptions)
        self._earliest_s = asyncio.get_running_loop().time() + pause_s
        self._subscriptions = 0
        self._next_change.set()
        self._next_change = asyncio.Event()
