"""Write a sequence in TUM layout as a ROS bag: python tools/write_bag.py FOLDER run1.bag (or run1.mcap, or run1).

The bag has the folder's images, poses and camera without any loss, so mapping it gives the same map, bit for bit. A
name without ending gives the folder of a ROS 2 bag with SQLite.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gausslite.datasets.files import first_readable_size, read_rows
from gausslite.datasets.tum import read_tum_camera
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.lens import Lens

COLOUR_FRAME, WORLD_FRAME = "camera_color_optical_frame", "odom"
COLOUR = "/camera/color"
_TUM_UNITS_PER_METRE = 5000.0


class BagWriter:
    """Writes messages of any type from dictionaries of their fields, in the serialisation of ROS 1 or ROS 2."""

    def __init__(self, writer: Writer1 | Writer2, ros1: bool) -> None:
        self._writer, self._ros1 = writer, ros1
        self._store = _typestore(ros1)
        self._connections: dict[str, Any] = {}

    @classmethod
    @contextlib.contextmanager
    def open(cls, path: Path) -> Iterator[BagWriter]:
        """Open a new bag: the file NAME.bag of ROS 1, the file NAME.mcap or the folder NAME of ROS 2."""
        if path.exists():
            raise SystemExit(f"{path}: expected the name of a new bag, got one that exists")
        if path.suffix == ".bag":
            with Writer1(path) as writer:
                yield cls(writer, ros1=True)
            return
        if path.suffix != ".mcap":
            with Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
                yield cls(writer, ros1=False)
            return
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            with Writer2(Path(folder) / path.stem, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                yield cls(writer, ros1=False)
            (Path(folder) / path.stem / path.name).rename(path)

    def write(self, topic: str, message_type: str, time_ns: int, fields: dict[str, Any]) -> None:
        """Write one message; nested messages are dictionaries, and names of fields are those of ROS 2."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, message_type, typestore=self._store)
        message = self._message(message_type, fields)
        if self._ros1:
            data = self._store.serialize_ros1(message, message_type)
        else:
            data = self._store.serialize_cdr(message, message_type)
        self._writer.write(self._connections[topic], time_ns, data)

    def _message(self, message_type: str, fields: dict[str, Any]) -> Any:
        values = {}
        for name, (kind, description) in self._store.fielddefs[message_type][1]:
            value = fields.get(name, fields.get(name.lower()))
            values[name] = self._value(kind, description, value)
        return self._store.types[message_type](**values)

    def _value(self, kind: Any, description: Any, value: Any) -> Any:
        if kind.name == "NAME":
            return self._message(description, value or {})
        if kind.name == "BASE":
            return ("" if description[0] == "string" else 0) if value is None else value
        (element_kind, element), length = description
        if element_kind.name == "NAME":
            return [self._message(element, fields) for fields in value or []]
        array = np.zeros(length, element[0]) if value is None else np.asarray(value, element[0])
        return array.ravel()


@functools.cache
def _typestore(ros1: bool) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def header(time_ns: int, frame: str) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


def image(time_ns: int, frame: str, encoding: str, pixels: np.ndarray) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/Image."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    return {
        "header": header(time_ns, frame),
        "height": height,
        "width": width,
        "encoding": encoding,
        "step": len(data) // height,
        "data": data,
    }


def transform(
    time_ns: int, parent: str, child: str, translation_m: tuple[float, ...], quat_xyzw: tuple[float, ...]
) -> dict[str, Any]:
    """Return the fields of a geometry_msgs/TransformStamped."""
    return {
        "header": header(time_ns, parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", translation_m, strict=True)),
            "rotation": dict(zip("xyzw", quat_xyzw, strict=True)),
        },
    }


def camera_info(time_ns: int, frame: str, intrinsics: tuple[float, ...], size: tuple[int, int]) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/CameraInfo without distortion; intrinsics: fx fy cx cy."""
    fx, fy, cx, cy = intrinsics
    return {
        "header": header(time_ns, frame),
        "width": size[0],
        "height": size[1],
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
        "r": np.eye(3),
        "p": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    }


@dataclass(frozen=True, slots=True)
class TumFolder:
    """The rows of a folder in TUM layout, with times in nanoseconds."""

    colour: list[tuple[int, Path]]
    depth: list[tuple[int, Path]]
    poses: list[tuple[int, list[float]]]
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    lens: Lens | None
    units_per_metre: float

    @classmethod
    def read(cls, folder: Path) -> TumFolder:
        """Read a folder with a camera file, or one named after fr1, fr2 or fr3. Raises DatasetError."""
        images = {
            kind: [(_nanoseconds(fields[0]), folder / fields[1]) for _, fields in read_rows(folder / f"{kind}.txt")]
            for kind in ("rgb", "depth")
        }
        rows = [fields for _, fields in read_rows(folder / "groundtruth.txt")]
        poses = [(_nanoseconds(fields[0]), [float(value) for value in fields[1:]]) for fields in rows]
        found = read_tum_camera(folder, *first_readable_size(path for _, path in images["rgb"]))
        camera = found.camera
        intrinsics = camera.fx_px, camera.fy_px, camera.cx_px - 0.5, camera.cy_px - 0.5
        units = found.units_per_metre or _TUM_UNITS_PER_METRE
        size = camera.width_px, camera.height_px
        return cls(images["rgb"], images["depth"], poses, intrinsics, size, found.lens, units)


def write_tum_bag(folder: Path, path: Path, compressed: bool = False) -> None:
    """Write all images and poses of a folder; compressed: colour as PNG and 16-bit depth as compressedDepth."""
    content = TumFolder.read(folder)
    with BagWriter.open(path) as bag:
        first_ns = content.colour[0][0]
        info = camera_info(first_ns, COLOUR_FRAME, content.intrinsics, content.size)
        if content.lens is not None:
            info["d"] = list(content.lens.coefficients)
        bag.write(f"{COLOUR}/camera_info", "sensor_msgs/msg/CameraInfo", first_ns, info)
        for time_ns, file in content.colour:
            _write_colour(bag, time_ns, file, compressed)
        for time_ns, file in content.depth:
            _write_depth(bag, time_ns, file, content.units_per_metre, compressed)
        for time_ns, (*translation_m, x, y, z, w) in content.poses:
            pose = transform(time_ns, WORLD_FRAME, COLOUR_FRAME, tuple(translation_m), (x, y, z, w))
            bag.write("/tf", "tf2_msgs/msg/TFMessage", time_ns, {"transforms": [pose]})


def _write_colour(bag: BagWriter, time_ns: int, file: Path, compressed: bool) -> None:
    if compressed:
        fields = {
            "header": header(time_ns, COLOUR_FRAME),
            "format": f"rgb8; {file.suffix.removeprefix('.')} compressed bgr8",
            "data": np.frombuffer(file.read_bytes(), np.uint8),
        }
        bag.write(f"{COLOUR}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", time_ns, fields)
        return
    pixels = _read_image(file, cv2.IMREAD_COLOR)
    bag.write(f"{COLOUR}/image_raw", "sensor_msgs/msg/Image", time_ns, image(time_ns, COLOUR_FRAME, "bgr8", pixels))


def _write_depth(bag: BagWriter, time_ns: int, file: Path, units_per_metre: float, compressed: bool) -> None:
    raw = _read_image(file, cv2.IMREAD_UNCHANGED)
    topic = "/camera/aligned_depth_to_color/image_raw"
    if units_per_metre != 1000.0:
        metres = raw.astype(np.float32) / np.float32(units_per_metre)
        fields = image(time_ns, COLOUR_FRAME, "32FC1", metres)
    elif compressed:
        data = np.concatenate([np.zeros(12, np.uint8), np.frombuffer(file.read_bytes(), np.uint8)])
        fields = {"header": header(time_ns, COLOUR_FRAME), "format": "16UC1; compressedDepth png", "data": data}
        bag.write(f"{topic}/compressedDepth", "sensor_msgs/msg/CompressedImage", time_ns, fields)
        return
    else:
        fields = image(time_ns, COLOUR_FRAME, "16UC1", raw)
    bag.write(topic, "sensor_msgs/msg/Image", time_ns, fields)


def _read_image(file: Path, flags: int) -> np.ndarray:
    pixels = cv2.imread(str(file), flags)
    if pixels is None:
        raise SystemExit(f"{file}: expected an image")
    return pixels


def _nanoseconds(seconds: str) -> int:
    return int(Decimal(seconds) * 10**9)


def main() -> None:
    """Convert the folder of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="a sequence in TUM layout")
    parser.add_argument("bag", type=Path, help="NAME.bag (ROS 1), NAME.mcap or the folder NAME (ROS 2)")
    parser.add_argument("--compressed", action="store_true", help="compressed images instead of raw ones")
    options = parser.parse_args()
    try:
        write_tum_bag(options.folder, options.bag, options.compressed)
    except GaussLiteError as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
