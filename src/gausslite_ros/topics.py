"""Choose the topics of colour, depth and cameras in a bag, also in recordings of the RealSense SDK.

A stream's topics begin with its name, such as /device_0/sensor_1/Color_0. All frame_ids are equal, or missing.

STREAM/tf/N holds the extrinsics from the reference stream of group N to the stream, as T_stream_reference:
p_stream = R @ p_reference + t. Sources in librealsense: rs2_extrinsics in h/rs_sensor.h (R is column-major) and
rs2_transform_point_to_point in rsutil.h (the direction); ros_writer::write_extrinsics and device::get_extrinsics, which
fetches them from the group's reference to the stream; rot2quat in ros_file_format.h, whose w may be negative.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.datasets.pose_track import pose_from_quaternion
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import image_size
from gausslite.domain.pose import inverse
from gausslite_ros.bag_file import BagFile, BagOptions
from gausslite_ros.messages import (
    COLOUR_ENCODINGS,
    DEPTH_ENCODINGS,
    RECORD_DEPTH,
    ImageKind,
    frame_name,
    kind_of_compressed,
    kind_of_encoding,
    quaternion_of,
    translation_of,
)
from gausslite_ros.transforms import Transform

IMAGE_END, INFO_END = "/image/data", "/info/camera_info"
_EXTRINSICS = re.compile(r"(/device_\d+/sensor_\d+/\w+)/tf/(\d+)")
_SENSOR = re.compile(r"(/device_\d+/sensor_\d+)/")
_DEPTH_UNITS = re.compile(r"/option/Depth.Units/value")


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


def depth_units_per_metre(bag: BagFile, depth_topic: str) -> float | None:
    """Return the units of depth by the option "Depth Units" of the stream's sensor; None without it.

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
    return None


IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_TRANSPORTS = ("/compressed", "/compressedDepth")
_ALIGNED = re.compile(r"aligned_depth|depth_registered|depth_to_(?:color|rgb)")
_MAX_LISTED = 20


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A topic of images, as its first message describes it."""

    name: str
    compressed: bool
    kind: ImageKind
    encoding: str
    frame: str
    size: tuple[int, int] | None

    @property
    def camera_name(self) -> str:
        """The topic without the transport that compresses it."""
        return camera_name(self.name)

    def __str__(self) -> str:
        """Return the name with the encoding, for messages."""
        return f"{self.name} ({self.encoding or 'format not stated'})"


def camera_name(image_topic: str) -> str:
    """Return an image topic without the transport that compresses it."""
    for transport in _TRANSPORTS:
        if image_topic.endswith(transport):
            return image_topic.removesuffix(transport)
    return image_topic


def image_topics(bag: BagFile) -> list[ImageTopic]:
    """Return the image topics that have messages. Raises DatasetError."""
    found = []
    for name, message_type in bag.types.items():
        if message_type not in (IMAGE, COMPRESSED):
            continue
        message = bag.first(name)
        if message is None:
            continue
        compressed = message_type == COMPRESSED
        encoding = str(message.format if compressed else message.encoding)[:60]
        data = bytes(message.data) if compressed else b""
        kind = kind_of_compressed(encoding, data) if compressed else kind_of_encoding(encoding)
        stream = stream_of(name)
        if stream is not None and encoding == "mono16":
            # the RealSense SDK names the encoding of its depth so
            kind = ImageKind.DEPTH
        frame = stream or frame_name(message.header.frame_id)
        size = image_size(data) if compressed else (int(message.width), int(message.height))
        found.append(ImageTopic(name, compressed, kind, encoding, frame, size))
    return found


def choose_colour(bag: BagFile, topics: Sequence[ImageTopic], options: BagOptions) -> ImageTopic:
    """Return the topic of color=, else the only one with colour images, else the only one with grey images.

    A raw topic goes before its compressed copy. Raises DatasetError with a list if the choice is not clear.
    """
    if options.color:
        return _named(bag, topics, options.color, "color")
    for kind in (ImageKind.COLOUR, ImageKind.GREY):
        candidates = _without_copies(topic for topic in topics if topic.kind is kind)
        if candidates:
            return _only(bag, candidates, "colour", "color")
    raise DatasetError(
        f"{bag.path}: expected a topic with colour images, got {_listed(bag, topics)}; choose one with color=TOPIC, of "
        f"the encodings {', '.join(COLOUR_ENCODINGS)}, or with JPEG or PNG images"
    )


def choose_depth(bag: BagFile, topics: Sequence[ImageTopic], colour: ImageTopic, options: BagOptions) -> ImageTopic:
    """Return the topic of depth=, else the only one with depth, or the only one that is aligned to colour.

    Raises DatasetError with a list if the choice is not clear.
    """
    if options.depth:
        return _named(bag, topics, options.depth, "depth")
    candidates = _without_copies(topic for topic in topics if topic.kind is ImageKind.DEPTH)
    if candidates:
        aligned = [topic for topic in candidates if is_aligned(options, topic.name, topic.frame, colour.frame)]
        return _only(bag, aligned or candidates, "depth", "depth")
    for topic in topics:
        if topic.kind is ImageKind.OTHER and topic.encoding.startswith(DEPTH_ENCODINGS):
            raise DatasetError(f"{bag.path}: {topic}: depth as JPEG has 8 bits, too few to be used; {RECORD_DEPTH}")
    raise DatasetError(
        f"{bag.path}: expected a topic with depth ({', '.join(DEPTH_ENCODINGS)}), got {_listed(bag, topics)}; "
        "if one of them is depth, as mono16 may be, name it with depth=TOPIC"
    )


def is_aligned(options: BagOptions, depth_topic: str, depth_frame: str, colour_frame: str) -> bool:
    """True if depth belongs to the colour pixels, as aligned= states.

    Else depth is aligned if it has the colour camera's frame, or the name that drivers give to aligned depth, and no
    camera of its own is chosen with depth_info=.
    """
    if options.aligned:
        return options.aligned == "yes"
    return not options.depth_info and (depth_frame == colour_frame or bool(_ALIGNED.search(depth_topic)))


def choose_info(bag: BagFile, image: ImageTopic, named: str, option: str) -> str:
    """Return the camera_info topic of an image topic: the named one, its neighbour, or the only one of its frame.

    Raises DatasetError with a list if there is none.
    """
    infos = [name for name, message_type in bag.types.items() if message_type == CAMERA_INFO]
    if named:
        if named not in infos:
            raise DatasetError(f"{bag.path}: {option}={named}: expected a camera_info topic of {infos or 'none'}")
        return named
    name = image.camera_name
    neighbours = [f"{name.rpartition('/')[0]}/camera_info", f"{name}/camera_info"]
    stream = stream_of(name)
    if stream is not None:
        neighbours.insert(0, stream + INFO_END)
    for neighbour in neighbours:
        if neighbour in infos:
            return neighbour
    same_frame = [info for info in infos if _frame_of(bag, info) == image.frame]
    if len(same_frame) == 1:
        return same_frame[0]
    got = ", ".join(infos) or "no camera_info topic"
    raise DatasetError(
        f"{bag.path}: {image.name}: expected its camera in {neighbours[0]}, got {got}; choose one with {option}=TOPIC"
        + (", or state the camera with camera_file=FILE" if option == "color_info" else ", or state aligned=yes")
    )


def _frame_of(bag: BagFile, topic: str) -> str | None:
    message = bag.first(topic)
    return None if message is None else frame_name(message.header.frame_id)


def _named(bag: BagFile, topics: Sequence[ImageTopic], name: str, option: str) -> ImageTopic:
    for topic in topics:
        if topic.name == name:
            return topic
    got = ", ".join(map(str, topics)) or "no image topic with messages"
    raise DatasetError(f"{bag.path}: {option}={name}: expected an image topic of the bag, got one of: {got}")


def _only(bag: BagFile, candidates: Sequence[ImageTopic], kind: str, option: str) -> ImageTopic:
    if len(candidates) == 1:
        return candidates[0]
    listed = ", ".join(map(str, candidates))
    raise DatasetError(
        f"{bag.path}: {len(candidates)} topics have {kind} images: {listed}; choose one with {option}=TOPIC, "
        f"as in 'bag:{bag.path.name}?{option}={candidates[0].name}'"
    )


def _without_copies(topics: Iterable[ImageTopic]) -> list[ImageTopic]:
    """Return the topics without the compressed copies of raw ones."""
    found = list(topics)
    raw = {topic.name for topic in found if not topic.compressed}
    return [topic for topic in found if not topic.compressed or topic.camera_name not in raw]


def _listed(bag: BagFile, topics: Sequence[ImageTopic]) -> str:
    """Return the image topics with their encodings; the others with their types if there are none."""
    types = bag.types
    read = {topic.name: str(topic) for topic in topics}
    images = [name for name, message_type in types.items() if message_type in (IMAGE, COMPRESSED)]
    others = [f"{name} ({message_type})" for name, message_type in types.items()]
    names = [read.get(name, f"{name} (no message)") for name in images] or others
    return ", ".join(names[:_MAX_LISTED]) + (" ..." if len(names) > _MAX_LISTED else "") or "an empty bag"
