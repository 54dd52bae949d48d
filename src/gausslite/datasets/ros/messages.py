"""The fields of ROS messages that are read, of ROS 1 and ROS 2 alike: from a bag or from a live node."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

from gausslite.domain.errors import DatasetError

_MAX_NAME_CHARACTERS = 256


@runtime_checkable
class Header(Protocol):
    """std_msgs/Header."""

    stamp: Any
    frame_id: str


@runtime_checkable
class ImageMessage(Protocol):
    """sensor_msgs/Image."""

    header: Any
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


@runtime_checkable
class CompressedImageMessage(Protocol):
    """sensor_msgs/CompressedImage."""

    header: Any
    format: str
    data: Any


@runtime_checkable
class TransformMessage(Protocol):
    """geometry_msgs/TransformStamped: the pose of the child frame in the header's frame."""

    header: Any
    child_frame_id: str
    transform: Any


def stamp_ns(header: Header) -> int:
    """Return a header's time in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_name(name: str) -> str:
    """Return the name of a frame without the slash with which old systems begin it. Raises DatasetError."""
    if len(name) > _MAX_NAME_CHARACTERS:
        raise DatasetError(f"frame_id: expected at most {_MAX_NAME_CHARACTERS} characters, got {len(name)}")
    return name.removeprefix("/")


def translation_of(vector: Any) -> tuple[float, float, float]:
    """Return a geometry_msgs/Vector3 or Point in metres."""
    return float(vector.x), float(vector.y), float(vector.z)


def quaternion_of(rotation: Any) -> tuple[float, float, float, float]:
    """Return a geometry_msgs/Quaternion in the order x y z w."""
    return float(rotation.x), float(rotation.y), float(rotation.z), float(rotation.w)


def float_field(message: Any, lower_case_name: str) -> Sequence[float]:
    """Return a field of numbers of camera_info: ROS 1 writes its name in upper case, ROS 2 in lower case."""
    values: Iterable[float] = getattr(message, lower_case_name, None)  # type: ignore[assignment]
    if values is None:
        values = getattr(message, lower_case_name.upper())
    return [float(value) for value in values]
