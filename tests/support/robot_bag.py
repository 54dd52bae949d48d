"""Bags of a robot whose depth camera stands beside the colour camera, and their messages in the order of arrival."""

from collections.abc import Iterator, Mapping
from itertools import cycle, islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from exported_recordings import home_frames, quaternion_row
from tool_modules import load_tool

from gausslite_ros.bag_file import BagFile, BagOptions
from gausslite_ros.live_frames import LiveFrames
from gausslite_ros.messages import stamp_ns

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 33_333_333
COLOUR, COLOUR_INFO = "/camera/color/image_raw", "/camera/color/camera_info"
DEPTH, DEPTH_INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
BASE, CAMERA, DEPTH_CAMERA = "base_link", "camera_color_optical_frame", "camera_depth_optical_frame"
DELAYS_NS = {DEPTH: 60_000_000, "/tf": 250_000_000, DEPTH_INFO: 40_000_000}
"""By how much later messages of a topic may arrive than those of another with the same stamp."""


def load_write_bag() -> ModuleType:
    """Return tools/write_bag.py as a module."""
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    return load_tool("write_bag")


def write_robot_bag(path: Path, frames: int = 6, axes: str = "optical") -> BagOptions:
    """Write colour with a lens, depth of a second camera, tf at 100 Hz and the fixed frames; return its topics.

    axes "body": the camera frames have x forward, as their poses in tf.
    """
    tool = load_write_bag()
    T_optical = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]) if axes == "body" else np.eye(4)
    T_base_camera = np.array([[0.0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]) @ T_optical.T
    # rendering takes longer than all else
    home = list(islice(cycle(home_frames(min(frames, 6))), frames))
    k = home[0].camera
    size = k.width_px, k.height_px
    intrinsics = k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5

    def link(time_ns: int, parent: str, child: str, T: np.ndarray) -> dict[str, Any]:
        row = quaternion_row(T)
        return tool.transform(time_ns, parent, child, tuple(row[:3]), tuple(row[3:]))

    with tool.BagWriter.open(path) as bag:
        T_depth = np.eye(4)
        T_depth[:3, 3] = T_optical[:3, :3] @ (0.015, 0.001, 0.0)
        fixed = [
            link(START_NS, BASE, CAMERA, T_base_camera),
            link(START_NS, CAMERA, DEPTH_CAMERA, np.linalg.inv(T_depth)),
        ]
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS - FRAME_NS, {"transforms": fixed})
        for topic, frame in ((COLOUR_INFO, CAMERA), (DEPTH_INFO, DEPTH_CAMERA)):
            info = tool.camera_info(START_NS, frame, intrinsics, size)
            if topic == COLOUR_INFO:
                info["d"] = [0.1, -0.05, 0.001, 0.0, 0.0]
            bag.write(topic, "sensor_msgs/msg/CameraInfo", START_NS - FRAME_NS, info)
        for i, frame in enumerate(home):
            time_ns = START_NS + i * FRAME_NS
            colour = tool.image(time_ns, CAMERA, "rgb8", frame.rgb)
            bag.write(COLOUR, "sensor_msgs/msg/Image", time_ns, colour)
            if i != 2:
                depth = tool.image(time_ns + 5_000_000, DEPTH_CAMERA, "32FC1", frame.depth_m)
                bag.write(DEPTH, "sensor_msgs/msg/Image", time_ns + 5_000_000, depth)
        for j in range(-2, int(frames * FRAME_NS / 10_000_000) + 1):
            time_ns = START_NS + j * 10_000_000
            T_odom_base = home[0].T_world_camera.copy()
            T_odom_base[0, 3] += 0.002 * j
            message = {"transforms": [link(time_ns, "odom", BASE, T_odom_base)]}
            bag.write("/tf", "tf2_msgs/msg/TFMessage", time_ns, message)
    return BagOptions(COLOUR, DEPTH, COLOUR_INFO, DEPTH_INFO, frame="odom", axes=axes)


def arrivals(path: Path, delays_ns: Mapping[str, int]) -> Iterator[tuple[str, Any]]:
    """Yield topic and message in the order of recording plus each topic's delay."""
    bag, found = BagFile(path), []
    for topic in bag.types:
        delay_ns = delays_ns.get(topic, 0)
        if topic in ("/tf", "/tf_static"):
            found += [(stamp_ns(m.transforms[0].header) + delay_ns, topic, m) for m in bag.messages(topic)]
        else:
            found += [(s.key.recorded_ns + delay_ns, topic, bag.read(s.key)) for s in bag.stamps(topic)]
    for _, topic, message in sorted(found, key=lambda arrival: arrival[:2]):
        yield topic, message


def feed(live: LiveFrames, options: BagOptions, topic: str, message: Any) -> None:
    """Give a message to the converter, as the node's subscriptions do."""
    if topic in ("/tf", "/tf_static"):
        live.add_transforms(message.transforms, topic == "/tf_static")
    handlers = {
        options.color: live.add_colour,
        options.depth: live.add_depth,
        options.color_info: live.add_colour_info,
        options.depth_info: live.add_depth_info,
    }
    if topic in handlers:
        handlers[topic](message)
