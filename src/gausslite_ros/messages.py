"""Decode ROS messages, of ROS 1 and ROS 2 alike: images, compressed depth, and camera_info as camera and lens."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.datasets.camera_files import FolderCamera, lens_of
from gausslite.datasets.files import decode_image, depth_in_metres, high_bytes, require_pixel_count
from gausslite.domain.camera import FileIntrinsics
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
    """Return a header's time in nanoseconds; rospy names its parts in another way than bags and ROS 2."""
    stamp = header.stamp
    if hasattr(stamp, "secs"):
        return int(stamp.secs) * 10**9 + int(stamp.nsecs)
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


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


def camera_of(location: str, info: Any, image_topic: str) -> FolderCamera:
    """Return the camera of a topic's images, and its lens if they are distorted.

    A topic whose last part begins with image_rect has rectified images: the
    projection matrix P describes them, without distortion. Binning and region of interest of the message are applied.
    Raises DatasetError with the location.
    """
    fx = fy = cx = cy = 0.0
    lens = None
    if _is_rectified(image_topic):
        values = float_field(info, "p")
        fx, cx, fy, cy = (values[i] for i in (0, 2, 5, 6)) if len(values) == 12 else (0.0,) * 4
    else:
        lens = lens_of(location, str(info.distortion_model), float_field(info, "d"))
    if fx == 0.0:
        values = float_field(info, "k")
        if len(values) != 9 or values[0] == 0.0:
            raise DatasetError(f"{location}: expected an intrinsic matrix K, got zeros; is the camera calibrated?")
        fx, cx, fy, cy = (values[i] for i in (0, 2, 4, 5))
    binning = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    roi_size = int(info.roi.width), int(info.roi.height)
    size = roi_size if all(roi_size) else (int(info.width), int(info.height))
    cx, cy = cx - int(info.roi.x_offset), cy - int(info.roi.y_offset)
    intrinsics = FileIntrinsics(
        fx / binning[0], fy / binning[1], (cx + 0.5) / binning[0] - 0.5, (cy + 0.5) / binning[1] - 0.5
    )
    return FolderCamera(intrinsics.camera(location, size[0] // binning[0], size[1] // binning[1]), lens=lens)


def _is_rectified(image_topic: str) -> bool:
    return any(part.startswith("image_rect") for part in image_topic.split("/"))


_MILLIMETRES_PER_METRE = 1000.0
_PNG, _JPEG = b"\x89PNG", b"\xff\xd8\xff"
RECORD_DEPTH = "record the raw topic or its compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")
"""compressedDepth: a format number and the two quantisation parameters stand before the PNG."""

# OpenCV names a Bayer pattern after its second row and column, ROS after its first
_CONVERSION_CODES = {
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "YUYV": (2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Bytes per pixel of an encoding, and OpenCV's conversion of it to RGB."""
_CHANNEL_ORDERS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
    "rgb16": (3, (0, 1, 2)),
    "bgr16": (3, (2, 1, 0)),
    "16UC3": (3, (2, 1, 0)),
    "rgba16": (4, (0, 1, 2)),
    "bgra16": (4, (2, 1, 0)),
}
"""Channels of an encoding, and the places of red, green and blue."""
_PLANAR = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
"""Encodings with a plane of brightness and one of colour at half its height; OpenCV's conversions to RGB."""
COLOUR_ENCODINGS = (*_CHANNEL_ORDERS, *_CONVERSION_CODES, *_PLANAR)
_GREY = ("mono8", "8UC1")
DEPTH_ENCODINGS = ("16UC1", "32FC1")


class ImageKind(Enum):
    """What a topic's images show."""

    COLOUR = "colour"
    GREY = "grey"
    DEPTH = "depth"
    OTHER = "other"


def kind_of_encoding(encoding: str) -> ImageKind:
    """Return what images of this encoding of sensor_msgs/Image show."""
    if encoding in DEPTH_ENCODINGS:
        return ImageKind.DEPTH
    if encoding in _GREY:
        return ImageKind.GREY
    return ImageKind.COLOUR if encoding in COLOUR_ENCODINGS else ImageKind.OTHER


def kind_of_compressed(text: str, data: bytes) -> ImageKind:
    """Return what a compressed image shows, by its format, such as "rgb8; jpeg compressed bgr8", and its first bytes.

    JPEG has 8 bits per value: depth in it is of no use.
    """
    encoding = text.partition(";")[0].strip()
    is_depth = encoding in DEPTH_ENCODINGS
    if "compressedDepth" in text:
        return ImageKind.DEPTH
    if data.startswith(_JPEG):
        return ImageKind.OTHER if is_depth else ImageKind.GREY if encoding in _GREY else ImageKind.COLOUR
    if not data.startswith(_PNG):
        return ImageKind.OTHER
    bits, channels = data[24:26]  # of the header, which is the first chunk
    if is_depth or (bits == 16 and channels == 0 and encoding != "mono16"):
        return ImageKind.DEPTH
    return ImageKind.GREY if encoding in _GREY else ImageKind.OTHER if bits == 16 else ImageKind.COLOUR


def decode_colour(location: str, message: ImageMessage) -> UInt8[ndarray, "h w 3"]:
    """Return an image message as RGB. Raises DatasetError with the location for other encodings and wrong sizes."""
    encoding = message.encoding
    if encoding in _CHANNEL_ORDERS:
        channels, order = _CHANNEL_ORDERS[encoding]
        has_16_bits = "16" in encoding
        pixels = _pixels(location, message, np.dtype(np.uint16 if has_16_bits else np.uint8), channels)[..., order]
        return np.ascontiguousarray(high_bytes(location, pixels) if has_16_bits else pixels)
    if encoding in _PLANAR:
        rows, channels, code = int(message.height) * 3 // 2, 1, _PLANAR[encoding]
    elif encoding in _CONVERSION_CODES:
        rows, (channels, code) = int(message.height), _CONVERSION_CODES[encoding]
    else:
        known = ", ".join(COLOUR_ENCODINGS)
        raise DatasetError(f"{location}: encoding: expected one of {known}, got {encoding[:40]!r}")
    try:
        pixels = _pixels(location, message, np.dtype(np.uint8), channels, rows)
        rgb: UInt8[ndarray, "h w 3"] = cv2.cvtColor(pixels, code)
    except cv2.error:
        size = f"{message.width}x{message.height}"
        raise DatasetError(f"{location}: {encoding}: expected an even width and height, got {size}") from None
    return rgb


def decode_depth(location: str, message: ImageMessage, units_per_metre: float | None = None) -> Float32[ndarray, "h w"]:
    """Return depth in metres, 0 where invalid, of 16-bit integers or 32FC1 in these units.

    None: millimetres and metres, as ROS defines them. Raises DatasetError with the location.
    """
    dtype = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}.get(message.encoding)
    if dtype is None:
        raise DatasetError(f"{location}: encoding: expected depth as 16UC1 or 32FC1, got {message.encoding[:40]!r}")
    image = _pixels(location, message, np.dtype(dtype), 1)
    return _in_metres(image, units_per_metre)


def decode_compressed_colour(location: str, message: CompressedImageMessage) -> UInt8[ndarray, "h w 3"]:
    """Return a JPEG or PNG image as RGB. Raises DatasetError with the location."""
    image = decode_image(location, bytes(message.data), cv2.IMREAD_COLOR)
    if image.dtype != np.uint8:
        raise DatasetError(f"{location}: expected an image of 8 bits per channel, got {image.dtype}")
    encoding = message.format.partition(";")[0].strip()
    if encoding.startswith("bayer_") and encoding in _CONVERSION_CODES:
        # the pattern is compressed as a grey image
        mosaic = np.ascontiguousarray(image[..., 0])
        return np.asarray(cv2.cvtColor(mosaic, _CONVERSION_CODES[encoding][1]))
    return np.ascontiguousarray(image[..., ::-1])


def decode_compressed_depth(
    location: str, message: CompressedImageMessage, units_per_metre: float | None = None
) -> Float32[ndarray, "h w"]:
    """Return depth in metres, 0 where invalid, of a 16-bit PNG, with the header of compressedDepth or without.

    32FC1 images are stored as quantised inverse depths: depth = A / (value - B). Raises DatasetError with the location.
    """
    data = bytes(message.data)
    if "compressedDepth" not in message.format:
        return _in_metres(_decode_16_bit(location, data), units_per_metre)
    if "rvl" in message.format.lower():
        raise DatasetError(
            f"{location}: expected compressedDepth with PNG, got RVL; record with format png, or raw depth"
        )
    if len(data) <= _DEPTH_HEADER.size:
        raise DatasetError(
            f"{location}: expected a header of {_DEPTH_HEADER.size} bytes and a PNG, got {len(data)} bytes"
        )
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    image = _decode_16_bit(location, data[_DEPTH_HEADER.size :])
    if message.format.partition(";")[0].strip() != "32FC1":
        return _in_metres(image, units_per_metre)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth_m = np.float32(a) / (image.astype(np.float32) - np.float32(b))
    depth_m[image == 0] = 0.0
    return _in_metres(depth_m, units_per_metre)


def _pixels(
    location: str, message: ImageMessage, dtype: np.dtype[Any], channels: int, rows: int | None = None
) -> NDArray[Any]:
    """Return the pixels of a raw image in this machine's byte order. The sizes are checked first.

    rows: those of the data, by default those of the image. A step of 0, which some drivers leave, is that of rows
    without padding.
    """
    width, height = int(message.width), int(message.height) if rows is None else rows
    require_pixel_count(location, width, height)
    row_bytes = width * channels * dtype.itemsize
    step = int(message.step) or row_bytes
    if step < row_bytes:
        raise DatasetError(f"{location}: step: expected at least {row_bytes} bytes a row, got {step}")
    data = np.frombuffer(message.data, np.uint8)
    if len(data) < step * (height - 1) + row_bytes:
        raise DatasetError(f"{location}: data: expected {height} rows of {step} bytes, got {len(data)} bytes")
    lines = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(lines).view(dtype)
    if bool(message.is_bigendian) != (sys.byteorder == "big"):
        pixels = pixels.byteswap()
    return pixels.reshape((height, width, channels) if channels > 1 else (height, width))


def _decode_16_bit(location: str, data: bytes) -> NDArray[Any]:
    if data.startswith(_JPEG):
        raise DatasetError(f"{location}: expected depth as a 16-bit PNG, got JPEG, which has 8 bits; {RECORD_DEPTH}")
    image = decode_image(location, data, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise DatasetError(
            f"{location}: expected a 16-bit PNG of one channel, got {image.dtype} of shape {image.shape}"
        )
    return image


def _in_metres(image: NDArray[Any], units_per_metre: float | None) -> Float32[ndarray, "h w"]:
    if image.dtype == np.float32:
        return _valid(image / np.float32(units_per_metre or 1.0))
    return depth_in_metres(image, units_per_metre or _MILLIMETRES_PER_METRE)


def _valid(depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Set NaN, infinite and negative depths to 0."""
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m
