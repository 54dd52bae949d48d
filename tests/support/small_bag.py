"""Bags of a few small images whose topics, frames and encodings a test may change."""

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from robot_bag import load_write_bag

from gausslite.datasets.open import open_source
from gausslite.domain.frame import Frame

START_NS, FRAME_NS, FRAMES = 1_000_000_000_000, 33_333_333, 8
SIZE = (32, 24)
INTRINSICS = 30.0, 30.0, 15.5, 11.5
COLOUR, DEPTH, OPTICAL = "/camera/color/image_raw", "/camera/depth/image_raw", "camera_color_optical_frame"
IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TF = "tf2_msgs/msg/TFMessage"
Writer = Any
"""BagWriter of tools/write_bag.py."""


def rgb_of(i: int) -> np.ndarray:
    """Return a smooth colour image, which JPEG keeps nearly as it is."""
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.stack([60 + 5 * columns, 40 + 6 * rows, np.full_like(rows, 20 * i)], axis=-1).astype(np.uint8)


def depth_mm_of(i: int) -> np.ndarray:
    """Return a 16-bit depth image."""
    return np.full(SIZE[::-1], 1500 + 10 * i, np.uint16)


def image(
    i: int, encoding: str, pixels: np.ndarray, frame: str = OPTICAL, time_ns: int | None = None
) -> dict[str, Any]:
    """Return the fields of an image of frame i."""
    fields: dict[str, Any] = load_write_bag().image(time_of(i) if time_ns is None else time_ns, frame, encoding, pixels)
    return fields | {"width": SIZE[0], "height": SIZE[1]}


def compressed(i: int, text: str, suffix: str, pixels: np.ndarray, before: bytes = b"") -> dict[str, Any]:
    """Return the fields of a compressed image of frame i; before: bytes in front of the file."""
    data = before + cv2.imencode(suffix, pixels)[1].tobytes()
    header = load_write_bag().header(time_of(i), OPTICAL)
    return {"header": header, "format": text, "data": np.frombuffer(data, np.uint8)}


def time_of(i: int) -> int:
    """Return the stamp of frame i."""
    return START_NS + i * FRAME_NS


def link(time_ns: int, parent: str, child: str, x_m: float = 0.0) -> dict[str, Any]:
    """Return the fields of a tf message of one transform."""
    pose = load_write_bag().transform(time_ns, parent, child, (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    return {"transforms": [pose]}


def write_small_bag(
    path: Path,
    *,
    colour: Callable[[Writer, int], None] | None = None,
    depth: Callable[[Writer, int], None] | None = None,
    namespace: str = "",
    frames: tuple[str, str] = ("odom", "base_link"),
    extra: Callable[[Writer], None] | None = None,
) -> Path:
    """Write a camera that moves by 1 cm a frame; colour, depth: write other messages of frame i."""
    tool = load_write_bag()
    with tool.BagWriter.open(path) as bag:
        bag.write("/camera/color/camera_info", INFO, START_NS, tool.camera_info(START_NS, OPTICAL, INTRINSICS, SIZE))
        bag.write(f"{namespace}/tf_static", TF, START_NS, link(START_NS, frames[1], OPTICAL))
        for i in range(FRAMES):
            bag.write(f"{namespace}/tf", TF, time_of(i), link(time_of(i), *frames, 0.01 * i))
            if colour is None:
                bag.write(COLOUR, IMAGE, time_of(i), image(i, "rgb8", rgb_of(i)))
            else:
                colour(bag, i)
            if depth is None:
                bag.write(DEPTH, IMAGE, time_of(i), image(i, "16UC1", depth_mm_of(i)))
            else:
                depth(bag, i)
        if extra is not None:
            extra(bag)
    return path


def frames_of(address: str | Path) -> list[Frame]:
    """Return all frames of a bag's address."""
    source = open_source(str(address))
    return [source.frame(i) for i in range(len(source))]


def require_small_bag(frames: list[Frame], count: int = FRAMES, tolerance: int = 0) -> None:
    """Fail unless these are the first frames of the bag; tolerance: of colour values."""
    assert [frame.index for frame in frames] == list(range(count))
    for frame in frames:
        assert np.abs(frame.rgb.astype(int) - rgb_of(frame.index)).max() <= tolerance
        np.testing.assert_allclose(frame.depth_m, depth_mm_of(frame.index) / 1000, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera[:3, 3], (0.01 * frame.index, 0, 0), atol=1e-9)


def record(code: int, content: bytes) -> bytes:
    """Return a record of an MCAP file."""
    return struct.pack("<BQ", code, len(content)) + content


def text(value: str | bytes) -> bytes:
    """Return a text, or bytes, with its length."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def schema(number: int, name: str, encoding: str, definition: str) -> bytes:
    """Return a schema record."""
    return record(3, struct.pack("<H", number) + text(name) + text(encoding) + text(definition))


def channel(number: int, topic: str, encoding: str) -> bytes:
    """Return a record of the channel with the schema of its number."""
    return record(4, struct.pack("<HH", number, number) + text(topic) + text(encoding) + text(b""))


def message(number: int, time_ns: int, data: bytes) -> bytes:
    """Return a message record."""
    return record(5, struct.pack("<HIQQ", number, 0, time_ns, time_ns) + data)


def chunk(
    records: Iterable[bytes], times_ns: tuple[int, int], compress: Callable[[bytes], bytes] | None = None
) -> bytes:
    """Return a chunk record; compress: with zstd."""
    data = b"".join(records)
    stored = data if compress is None else compress(data)
    name = text("" if compress is None else "zstd")
    return record(6, struct.pack("<QQQI", *times_ns, len(data), 0) + name + struct.pack("<Q", len(stored)) + stored)


def mcap(profile: str, parts: Iterable[bytes]) -> bytes:
    """Return an MCAP file without summary."""
    magic = b"\x89MCAP0\r\n"
    end = record(15, bytes(4)) + record(2, bytes(20))
    return magic + record(1, text(profile) + text("test")) + b"".join(parts) + end + magic


def mcap_parts(bag: Path) -> tuple[list[bytes], list[tuple[int, bytes]]]:
    """Return the channels of a bag, and its messages by time, as records of an MCAP file."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    is_ros1 = bag.suffix == ".bag"
    kind, serialisation = ("ros1msg", "ros1") if is_ros1 else ("ros2msg", "cdr")
    with (Reader1 if is_ros1 else Reader2)(bag) as reader:
        channels = []
        for connection in reader.connections:
            name = connection.msgtype.replace("/msg/", "/") if is_ros1 else connection.msgtype
            channels.append(schema(connection.id + 1, name, kind, connection.msgdef.data))
            channels.append(channel(connection.id + 1, connection.topic, serialisation))
        messages = [(time_ns, message(c.id + 1, time_ns, bytes(data))) for c, time_ns, data in reader.messages()]
    return channels, messages
