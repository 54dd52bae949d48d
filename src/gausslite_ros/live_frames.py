"""Join the messages of a running robot to frames: the frames that a bag of the same messages gives."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.camera_files import FolderCamera
from gausslite.datasets.pose_track import MAX_POSE_GAP_S
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.frame import ClockJumps, Frame
from gausslite.domain.lens import Lens
from gausslite_ros.bag_file import BagOptions
from gausslite_ros.cameras import FrameConverter, join_cameras, optical_pose, require_own_camera, same_camera
from gausslite_ros.messages import TransformMessage, camera_of, frame_name, stamp_ns
from gausslite_ros.topics import camera_name, is_aligned
from gausslite_ros.transforms import TransformWindow, transforms_of

MAX_WAIT_S = 1.5
"""Localisation nodes publish map → odom once a second."""
_MAX_IMAGES = 64
_PLACE = "topics"


@dataclass(frozen=True, slots=True)
class LiveCounters:
    """Colour images received, and what became of them; those that wait are not counted yet.

    not_ready: camera_info or the transform to the depth camera was missing, or the camera changed.
    overflow: too many images were waiting.
    clock_jumps: times that the stamps went back, after which all that waited was dropped as out of order.
    """

    received: int = 0
    converted: int = 0
    without_depth: int = 0
    without_pose: int = 0
    not_ready: int = 0
    damaged: int = 0
    out_of_order: int = 0
    overflow: int = 0
    clock_jumps: int = 0


@dataclass(frozen=True, slots=True)
class _Pending:
    number: int
    time_ns: int
    message: Any


class LiveFrames:
    """Converts messages in the order of their arrival. Not thread-safe.

    options: the topics (their names state whether images are rectified); frame: the world frame in tf. A colour image
    waits until a depth image and transforms of its time or later have arrived, at most max_wait_s by the images'
    stamps. Depth that is not aligned to colour, see `is_aligned`, is registered to it. If the stamps of images go back
    as `ClockJumps` describes, everything of the old clock is forgotten.
    """

    def __init__(self, options: BagOptions, max_wait_s: float = MAX_WAIT_S) -> None:
        self._options, self._max_wait_ns = options, round(max_wait_s * 1e9)
        self._colour_info: Any = None
        self._depth_info: Any = None
        self._converter: FrameConverter | None = None
        self._transforms = TransformWindow(max_wait_s + 2 * MAX_POSE_GAP_S)
        self._pending: deque[_Pending] = deque()
        self._depths: list[tuple[int, int, Any]] = []
        self._depths_received = 0
        self._newest_ns = self._last_taken_ns = -1
        self._colour_clock, self._depth_clock = ClockJumps(max_wait_s), ClockJumps(max_wait_s)
        self._counters = LiveCounters()
        self._problem = ""

    @property
    def counters(self) -> LiveCounters:
        """What became of the colour images so far."""
        return self._counters

    @property
    def problem(self) -> str:
        """What the latest image that gave no frame lacked, or waits for; empty after a frame."""
        return self._problem

    @property
    def lens(self) -> Lens | None:
        """Lens of the frames' images; None before the first frame."""
        return None if self._converter is None else self._converter.cameras.lens

    def add_colour(self, message: Any) -> None:
        """Add a colour image, raw or compressed. One that is not later than those before it is left out."""
        pending = _Pending(self._counters.received, stamp_ns(message.header), message)
        self._count("received")
        latest_ns = self._pending[-1].time_ns if self._pending else self._last_taken_ns
        if self._colour_clock.has_jumped(pending.time_ns, latest_ns):
            self._clear()
        elif pending.time_ns <= latest_ns:
            self._count("out_of_order")
            return
        self._pending.append(pending)
        self._newest_ns = max(self._newest_ns, pending.time_ns)
        if len(self._pending) > _MAX_IMAGES:
            self._pending.popleft()
            self._count("overflow")

    def add_depth(self, message: Any) -> None:
        """Add a depth image, raw or compressed."""
        time_ns = stamp_ns(message.header)
        if self._depth_clock.has_jumped(time_ns, self._depths[-1][0] if self._depths else -1):
            self._clear()
        self._newest_ns = max(self._newest_ns, time_ns)
        # the number keeps equal stamps in order, so that messages are not compared
        insort(self._depths, (time_ns, self._depths_received, message))
        self._depths_received += 1
        del self._depths[:-_MAX_IMAGES]

    def add_colour_info(self, message: Any) -> None:
        """Add the camera_info of colour; the first one counts until another states another camera."""
        if self._is_new_camera(self._colour_info, message, self._options.color):
            self._colour_info = message

    def add_depth_info(self, message: Any) -> None:
        """Add the camera_info of depth, as that of colour. Aligned depth needs none."""
        if self._is_new_camera(self._depth_info, message, self._options.depth):
            self._depth_info = message

    def add_transforms(self, messages: Iterable[TransformMessage], static: bool) -> None:
        """Add the transforms of one tf message; static: of /tf_static. Raises DatasetError for too long names."""
        self._transforms.add(transforms_of(messages, static))

    def _is_new_camera(self, held: Any, message: Any, topic: str) -> bool:
        """Return True for the first camera_info and for that of another camera; images from before it are dropped."""
        new = _camera_or_none(message, topic)
        known = None if held is None else _camera_or_none(held, topic)
        if held is not None and (new is None or (known is not None and same_camera(known, new))):
            return False
        self._converter = None
        waiting = len(self._pending)
        if held is not None:
            self._pending = deque(image for image in self._pending if image.time_ns >= stamp_ns(message.header))
        for _ in range(waiting - len(self._pending)):
            self._count("not_ready")
        return True

    def _clear(self) -> None:
        """Drop images, depths and moving transforms, which have stamps of another clock."""
        for _ in self._pending:
            self._count("out_of_order")
        self._count("clock_jumps")
        self._pending.clear()
        self._depths.clear()
        self._transforms.clear_moving()
        self._newest_ns = self._last_taken_ns = -1
        self._colour_clock.reset()
        self._depth_clock.reset()

    def take(self) -> list[Frame]:
        """Return the frames that have become complete, in the order of their stamps."""
        frames = []
        while self._pending:
            result = self._resolve(self._pending[0])
            if result is None:
                break
            self._last_taken_ns = self._pending.popleft().time_ns
            if isinstance(result, Frame):
                frames.append(result)
                self._problem = ""
            self._count("converted" if isinstance(result, Frame) else result)
        return frames

    def _resolve(self, image: _Pending) -> Frame | str | None:
        """Return the frame of a colour image, the counter that says why it has none, or None to wait."""
        expired = self._newest_ns - image.time_ns > self._max_wait_ns
        if self._converter is None:
            self._converter = self._connect(image.time_ns)
        if self._converter is None:
            return "not_ready" if expired else None
        if not expired and not (self._depth_has_passed(image.time_ns) and self._pose_is_final(image.time_ns)):
            return None
        depth = self._nearest_depth(image.time_ns)
        if depth is None:
            self._problem = f"no depth within {1000 * self._options.tolerance_s:g} ms of a colour image"
            return "without_depth"
        try:
            T_world_camera = self._pose(image.time_ns)
            if T_world_camera is None:
                return "without_pose"
            return self._converter.frame(_PLACE, image.number, (image.message, depth), image.time_ns, T_world_camera)
        except InvalidInputError as error:
            self._problem = str(error)
            return "damaged"

    def _connect(self, time_ns: int) -> FrameConverter | None:
        """Return the converter when both cameras and the transform between them are known."""
        options = self._options
        if self._colour_info is None or not self._depths:
            self._problem = f"waiting for {'camera_info' if self._colour_info is None else 'depth images'}"
            return None
        camera_frame, depth_frame = self._camera_frame(), frame_name(self._depths[0][2].header.frame_id)
        colour_frame = frame_name(self._pending[0].message.header.frame_id)
        aligned = is_aligned(options, options.depth, depth_frame, colour_frame)
        T_colour_depth: Float64[ndarray, "4 4"] | None = np.eye(4)
        depth: FolderCamera | None = None
        try:
            colour = _camera(self._colour_info, options.color)
            if not aligned and self._depth_info is None:
                self._problem = "waiting for the camera_info of depth, which is not aligned to colour"
                return None
            if not aligned:
                depth = _camera(self._depth_info, options.depth)
                tree = self._transforms.tree((camera_frame, depth_frame))
                T_colour_depth = tree.at(camera_frame, depth_frame, time_ns / 10**9)
                if T_colour_depth is not None and not options.aligned:
                    require_own_camera(f"{_PLACE}: {options.depth}", colour, depth, T_colour_depth)
        except InvalidInputError as error:
            self._problem = str(error)
            return None
        if T_colour_depth is None:
            self._problem = f"tf: no transform from {depth_frame!r} to {camera_frame!r} at the time of an image"
            return None
        cameras = join_cameras(colour, depth, T_colour_depth, options.axes)
        units_per_metre = 1 / options.depth_unit_m if options.depth_unit_m else None
        return FrameConverter(cameras, options.color, options.depth, units_per_metre)

    def _depth_has_passed(self, time_ns: int) -> bool:
        return bool(self._depths) and self._depths[-1][0] >= time_ns

    def _nearest_depth(self, time_ns: int) -> Any | None:
        """Return the nearest depth image within the tolerance; images too old for this and later ones are dropped."""
        tolerance_s = self._options.tolerance_s
        while self._depths and (time_ns - self._depths[0][0]) / 10**9 > tolerance_s:
            del self._depths[0]
        nearest = min(self._depths, key=lambda depth: abs(depth[0] - time_ns), default=None)
        if nearest is None or abs(nearest[0] - time_ns) / 10**9 > tolerance_s:
            return None
        return nearest[2]

    def _pose_is_final(self, time_ns: int) -> bool:
        """True if no later transform can change the pose at this time."""
        world, camera = self._options.frame, self._camera_frame()
        try:
            return self._transforms.tree((world, camera)).span_s(world, camera)[1] >= time_ns / 10**9
        except InvalidInputError as error:
            self._problem = str(error)
            return False

    def _pose(self, time_ns: int) -> Float64[ndarray, "4 4"] | None:
        """Return the optical frame's pose; None without transforms. Raises PoseError."""
        world, camera = self._options.frame, self._camera_frame()
        tree = self._transforms.tree((world, camera))
        try:
            tree.require_path(world, camera)
        except DatasetError as error:
            self._problem = str(error)
            return None
        T_world_camera = tree.at(world, camera, time_ns / 10**9)
        if T_world_camera is None:
            self._problem = f"tf: no transform from {camera!r} to {world!r} at the time of an image"
            return None
        return optical_pose(T_world_camera, self._options.axes)

    def _camera_frame(self) -> str:
        return self._options.camera or frame_name(self._pending[0].message.header.frame_id)

    def _count(self, name: str) -> None:
        self._counters = replace(self._counters, **{name: getattr(self._counters, name) + 1})


def _camera_or_none(info: Any, image_topic: str) -> FolderCamera | None:
    try:
        return _camera(info, image_topic)
    except InvalidInputError:
        return None


def _camera(info: Any, image_topic: str) -> FolderCamera:
    return camera_of(f"{_PLACE}: camera_info of {image_topic}", info, camera_name(image_topic))
