"""Recordings of the RealSense SDK (realsense-viewer, rs-record): ROS 1 bags with the SDK's own topics.

A stream's topics begin with its name, such as /device_0/sensor_1/Color_0. All frame_ids are equal, or missing.

STREAM/tf/N holds the extrinsics from the reference stream of group N to the stream, as T_stream_reference:
p_stream = R @ p_reference + t. Sources in librealsense: rs2_extrinsics in h/rs_sensor.h (R is column-major) and
rs2_transform_point_to_point in rsutil.h (the direction); ros_writer::write_extrinsics and device::get_extrinsics, which
fetches them from the group's reference to the stream; rot2quat in ros_file_format.h, whose w may be negative.
"""

from __future__ import annotations

import re

import numpy as np

from gausslite.datasets.poses import pose_from_quaternion
from gausslite.datasets.ros.bag_file import BagFile
from gausslite.datasets.ros.messages import quaternion_of, translation_of
from gausslite.datasets.ros.transform_tree import Transform
from gausslite.domain.errors import DatasetError
from gausslite.domain.pose import inverse

IMAGE_END, INFO_END = "/image/data", "/info/camera_info"
_EXTRINSICS = re.compile(r"(/device_\d+/sensor_\d+/\w+)/tf/(\d+)")
_SENSOR = re.compile(r"(/device_\d+/sensor_\d+)/")
_DEPTH_UNITS = re.compile(r"/option/Depth.Units/value")
_DEFAULT_UNITS_PER_METRE = 1000.0


def stream_of(image_topic: str) -> str | None:
    """Return the stream of an image topic of the SDK; None for other topics."""
    is_stream = _SENSOR.match(image_topic) and image_topic.endswith(IMAGE_END)
    return image_topic.removesuffix(IMAGE_END) if is_stream else None


def stream_transforms(bag: BagFile) -> list[Transform]:
    """Return the poses of the streams in their references; empty for other bags. Raises DatasetError, PoseError."""
    found = []
    for topic in bag.types:
        match = _EXTRINSICS.fullmatch(topic)
        message = bag.first(topic) if match else None
        if match is None or message is None:
            continue
        x, y, z, w = quaternion_of(message.rotation)
        T_stream_reference = pose_from_quaternion(
            f"{bag.path}: {topic}", np.array(translation_of(message.translation)), np.array((x, y, z, w))
        )
        x_m, y_m, z_m = inverse(T_stream_reference)[:3, 3].tolist()
        found.append(Transform(f"reference {match[2]}", match[1], None, (x_m, y_m, z_m), (-x, -y, -z, w)))
    return found


def depth_units_per_metre(bag: BagFile, depth_topic: str) -> float:
    """Return the units of 16-bit depth: of the option "Depth Units" of the stream's sensor, else millimetres.

    Raises DatasetError for units that are not positive.
    """
    sensor = _SENSOR.match(depth_topic)
    for topic in bag.types if sensor else ():
        if sensor and topic.startswith(sensor[1]) and _DEPTH_UNITS.fullmatch(topic.removeprefix(sensor[1])):
            message = bag.first(topic)
            if message is None:
                break
            unit_m = float(message.data)
            if not (np.isfinite(unit_m) and unit_m > 0):
                raise DatasetError(f"{bag.path}: {topic}: expected a positive unit in metres, got {unit_m}")
            # the unit is stored as float32: 0.001 has to become 1000
            return float(np.float32(1.0) / np.float32(unit_m))
    return _DEFAULT_UNITS_PER_METRE
