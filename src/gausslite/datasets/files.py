"""Read the images and text files of a sequence; each error names the file."""

from __future__ import annotations

import codecs
import re
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera
from gausslite.domain.checks import require_size
from gausslite.domain.errors import DatasetError
from gausslite.domain.file_formats import FOREIGN_BYTES, foreign_format
from gausslite.domain.frame import Frame, image_size

_MAX_IMAGE_PX = 1 << 26
_CUT_SHORT = "expected a whole image file, got one cut short"
_PGM_HEADER = re.compile(rb"P5(?:\s+#[^\n]*)*\s+(\d{1,6})\s+(\d{1,6})\s+(\d{3,5})\s")
_PNG_MAGIC, _JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_JPEG_MARKER = re.compile(rb"\xff+([^\x00\xff\x01\xd0-\xd7])", re.DOTALL)
"""The start of a JPEG segment; other bytes after FF belong to compressed pixels."""
_JPEG_START, _JPEG_END = b"\xd8", b"\xd9"
_SATURATED = np.iinfo(np.uint16).max
_MAX_OF_12_BITS, _WHOLE_RANGE = (1 << 12) - 1, 1 << 16
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_NOT_A_NUMBER = re.compile(r"[-+]?(?:nan\(.*\)|1\.#(?:QNAN|SNAN|IND)\w*)|NA", re.IGNORECASE)
"""NaN as the C library of Windows and tables of R write it."""
_SEPARATORS, _OTHER_SEPARATORS = re.compile(r"[\s,;\"']+"), re.compile(r"[\s;\"']+")
_DECIMAL_COMMA = re.compile(r"[-+]?\d{1,3}(?:\.\d{3})+,\d+|[-+]?\d*,\d+(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class DepthUnits:
    """Units per metre of a depth image."""

    per_metre: float  # 1000 for millimetres


@dataclass(frozen=True, slots=True, eq=False)
class RgbdImage:
    """A colour and a depth image of one size, with their camera."""

    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    camera: Camera
    recorded_rgb: UInt8[ndarray, "hr wr 3"] | None = None  # as in Frame

    def frame(self, number: int, time_ns: int, T_world_camera: Float64[ndarray, "4 4"]) -> Frame:
        """Return the frame of these images. Raises PoseError, InvalidInputError."""
        images = self.rgb, self.depth_m, self.camera
        return Frame(number, time_ns, *images, T_world_camera, recorded_rgb=self.recorded_rgb)

    def in_frame(self, frame: Frame) -> Frame:
        """Return the frame with these images and this camera in place of its own."""
        return replace(frame, rgb=self.rgb, depth_m=self.depth_m, camera=self.camera, recorded_rgb=self.recorded_rgb)


def read_colour(path: Path) -> UInt8[ndarray, "h w 3"]:
    """Return an 8-bit RGB image. Raises DatasetError with the file name."""
    bgr = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if bgr.dtype == np.uint16:
        bgr = high_bytes(str(path), bgr)
    rgb: UInt8[ndarray, "h w 3"] = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    return rgb


def high_bytes(location: str, pixels: UInt16[ndarray, "h w c"]) -> UInt8[ndarray, "h w c"]:
    """Return 16-bit colours with 8 bits. Raises DatasetError if they use at most 12 bits: the image would be black."""
    largest = int(pixels.max(initial=0))
    if largest <= _MAX_OF_12_BITS:
        raise DatasetError(
            f"{location}: expected colours of 8 bits, or of 16 bits over their whole range, got 16 bits with values up "
            f"to {largest}, as a camera of 10 or 12 bits writes; multiply them by {_WHOLE_RANGE // _range_of(largest)}"
        )
    return (pixels >> 8).astype(np.uint8)


def _range_of(largest: int) -> int:
    return next(size for size in (1 << 10, 1 << 12) if largest < size)


def first_readable_size(paths: Iterable[Path]) -> tuple[int, int]:
    """Return (width, height) of the first image that can be read. Raises the first error if none can."""
    first_error: DatasetError | None = None
    for path in paths:
        try:
            height, width = read_colour(path).shape[:2]
        except DatasetError as error:
            first_error = first_error or error
        else:
            return width, height
    raise first_error or DatasetError("expected an image, got none")


def read_depth(path: Path, units: DepthUnits) -> Float32[ndarray, "h w"]:
    """Return depth in metres, 0 if invalid, of a 16-bit image or a float32 .npy in these units. Raises DatasetError."""
    if path.suffix == ".npy":
        depth_m = (_read_npy(path) / np.float32(units.per_metre)).astype(np.float32, copy=False)
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
        return depth_m
    raw = _read_pgm(path) if path.suffix == ".pgm" else _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DatasetError(f"{path}: expected a 16-bit image of one channel, got {raw.dtype} of shape {raw.shape}")
    return depth_in_metres(raw, units.per_metre)


def depth_in_metres(raw: UInt16[ndarray, "h w"], per_metre: float) -> Float32[ndarray, "h w"]:
    """Return depth in metres of 16-bit units; 0 for the largest value, which cameras write beyond their range."""
    depth_m = raw.astype(np.float32) / np.float32(per_metre)
    depth_m[raw == _SATURATED] = 0.0
    return depth_m


def load_rgbd(
    colour_path: Path, depth_path: Path, camera: Camera, units: DepthUnits, size: tuple[int, int] | None
) -> RgbdImage:
    """Return both images of a frame at (width, height), or at the camera's own size if None. Raises DatasetError."""
    rgb, depth_m = read_colour(colour_path), read_depth(depth_path, units)
    if rgb.shape[:2] != depth_m.shape:
        raise DatasetError(f"{depth_path}: expected the size of {colour_path.name}, {_size(rgb)}, got {_size(depth_m)}")
    if rgb.shape[:2] != (camera.height_px, camera.width_px):
        expected = f"{camera.width_px}x{camera.height_px}"
        raise DatasetError(f"{colour_path}: expected the camera's size {expected}, got {_size(rgb)}")
    return resize_rgbd(RgbdImage(rgb, depth_m, camera), size)


def resize_rgbd(image: RgbdImage, size: tuple[int, int] | None) -> RgbdImage:
    """Resize an image to (width, height): colour by area, depth by nearest pixel (averages lie on no surface)."""
    if size is not None:
        require_size("size", size)
    if size is None or size == (image.camera.width_px, image.camera.height_px):
        return image
    width, height = size
    camera = image.camera.resized(width, height)
    rgb = cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA)
    recorded_rgb = image.rgb if width < image.camera.width_px else image.recorded_rgb
    return RgbdImage(rgb, resize_depth(image.depth_m, size), camera, recorded_rgb)


def resize_depth(depth_m: Float32[ndarray, "h w"], size: tuple[int, int]) -> Float32[ndarray, "ho wo"]:
    """Return the depth image at (width, height) by nearest pixel."""
    width, height = size
    rows = ((np.arange(height) + 0.5) * (depth_m.shape[0] / height)).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * (depth_m.shape[1] / width)).astype(np.int64)
    return np.ascontiguousarray(depth_m[np.ix_(rows, columns)])


def _read_npy(path: Path) -> Float32[ndarray, "h w"]:
    """Return a float32 image. Type, shape and size in the header are checked before memory is taken."""
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a depth image, got none") from None
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: expected a .npy file; {' '.join(str(error).split())[:120]}") from None
    if not isinstance(mapped, np.ndarray) or mapped.dtype != np.float32 or mapped.ndim != 2:
        got = f"{mapped.dtype} of shape {mapped.shape}" if isinstance(mapped, np.ndarray) else "an archive"
        raise DatasetError(f"{path}: expected a float32 image of one channel, got {got}")
    require_pixel_count(str(path), mapped.shape[1], mapped.shape[0])
    return np.array(mapped)


def _read_pgm(path: Path) -> UInt16[ndarray, "h w"]:
    """Return a 16-bit PGM image, as SensReader writes depth. Raises DatasetError."""
    data = _read_image(path)
    header = _PGM_HEADER.match(data)
    if header is None or int(header[3]) <= np.iinfo(np.uint8).max:
        raise DatasetError(f"{path}: expected a binary 16-bit PGM image, got a file which begins with {data[:16]!r}")
    width_px, height_px = int(header[1]), int(header[2])
    require_pixel_count(str(path), width_px, height_px)
    if len(data) < header.end() + 2 * width_px * height_px:
        raise DatasetError(f"{path}: {_CUT_SHORT}")
    raw = np.frombuffer(data, ">u2", width_px * height_px, header.end())
    return raw.reshape(height_px, width_px).astype(np.uint16)


def _read_image(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected an image, got none") from None
    except OSError as error:
        raise DatasetError(f"{path}: expected a readable image, got {type(error).__name__}") from None


def _decode(path: Path, flags: int) -> NDArray[Any]:
    return decode_image(str(path), _read_image(path), flags)


def decode_image(location: str, data: bytes, flags: int) -> NDArray[Any]:
    """Return a PNG or JPEG as OpenCV decodes it with these flags; bytes after the image's end are ignored.

    The pixels are those stored, without the turn that EXIF may state: depth, intrinsics and pose belong to them. Size
    and checksums are checked before memory is taken. Raises DatasetError with the location.
    """
    if not data.startswith((_PNG_MAGIC, _JPEG_MAGIC)):
        other = foreign_format(data[:FOREIGN_BYTES]) or f"another format, which begins with {data[:16]!r}"
        raise DatasetError(f"{location}: expected a PNG or JPEG image, got {other}")
    size_px = image_size(data)
    if size_px is not None:
        require_pixel_count(location, *size_px)
    # decoders fill a truncated file with grey without an error, so look for the end first
    is_whole = _is_whole_png(location, data) if data.startswith(_PNG_MAGIC) else _is_whole_jpeg(data)
    if size_px is None or not is_whole:
        raise DatasetError(f"{location}: {_CUT_SHORT}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DatasetError(f"{location}: expected an image, got bytes that cannot be decoded")
    return np.asarray(image)


def _is_whole_png(location: str, data: bytes) -> bool:
    """Return True if the end chunk is there. Raises DatasetError for a wrong checksum, on which libpng prints."""
    position = len(_PNG_MAGIC)
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        if end + 4 > len(data):
            return False
        if zlib.crc32(data[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise DatasetError(f"{location}: expected an undamaged image, got one whose checksum is wrong")
        if data[position + 4 : position + 8] == b"IEND":
            return True
        position = end + 4
    return False


def _is_whole_jpeg(data: bytes) -> bool:
    """Return True if the segments lead to the end marker; images inside a segment, such as thumbnails, do not count."""
    position = len(_JPEG_MAGIC)
    while marker := _JPEG_MARKER.search(data, position):
        if marker.group(1) in (_JPEG_START, _JPEG_END):
            return marker.group(1) == _JPEG_END
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return False


def require_pixel_count(location: str, width_px: int, height_px: int) -> None:
    """Raise DatasetError with the location for an empty image and for one that is too large for memory."""
    if not (width_px > 0 and height_px > 0 and width_px * height_px <= _MAX_IMAGE_PX):
        raise DatasetError(f"{location}: expected an image of 1 to {_MAX_IMAGE_PX} pixels, got {width_px}x{height_px}")


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def read_text(path: Path) -> str:
    """Return the text of UTF-8, of UTF-16 with a mark (PowerShell), or else of Latin-1. Raises DatasetError."""
    try:
        data = path.read_bytes()
        foreign = foreign_format(data[:FOREIGN_BYTES])
        if foreign and data.lstrip()[:1] not in (b"", b"{"):
            raise DatasetError(f"{path}: expected a text file, got {foreign}")
        if data.startswith(_UTF_16):
            return data.decode("utf-16")
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected a text file, got none") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: expected a readable text file, got {type(error).__name__}") from None
    if "\0" in text:
        raise DatasetError(f"{path}: expected a readable text file, got zero bytes; save it as UTF-8")
    return text


def read_lines(path: Path) -> list[tuple[str, str]]:
    """Return the location ("FILE line 3") and the text of each line, without blank lines and comments (#)."""
    lines = enumerate(map(str.strip, read_text(path).splitlines()), start=1)
    return [(f"{path} line {number}", text) for number, text in lines if text and not text.startswith("#")]


def read_rows(path: Path) -> list[tuple[str, list[str]]]:
    """Return the location and the fields of each row of numbers, separated by blanks, commas or semicolons.

    Quotes, empty rows and a header of words are left out, as spreadsheets write them.
    """
    lines = read_lines(path)
    require_points(lines)
    rows = [(location, [field for field in _SEPARATORS.split(text) if field]) for location, text in lines]
    rows = [(location, fields) for location, fields in rows if fields]
    return rows[1:] if rows and not any(map(is_number, rows[0][1])) else rows


def require_points(lines: Iterable[tuple[str, str]]) -> None:
    """Raise DatasetError for numbers with a decimal comma, among separators that are none: commas separate fields."""
    for location, text in lines:
        fields = [field for field in _OTHER_SEPARATORS.split(text) if field.strip(",")]
        with_comma = [field for field in fields if "," in field]
        if len(fields) > 1 and with_comma and all(map(_DECIMAL_COMMA.fullmatch, with_comma)):
            raise DatasetError(
                f"{location}: expected a point as the decimal mark, got the decimal comma of {with_comma[0]!r}"
            )


def is_number(text: str) -> bool:
    """Return True for a number, which may be NaN or infinite."""
    try:
        _number(text)
    except ValueError:
        return False
    return True


def parse_numbers(location: str, fields: list[str], count: int, meaning: str) -> list[float]:
    """Return exactly `count` numbers, which may be NaN or infinite. Raises DatasetError with the location."""
    if len(fields) != count:
        raise DatasetError(f"{location}: expected {count} numbers ({meaning}), got {len(fields)}")
    try:
        return [_number(field) for field in fields]
    except ValueError as error:
        raise DatasetError(f"{location}: expected {count} numbers ({meaning}); {error}") from None


def _number(text: str) -> float:
    return float("nan" if _NOT_A_NUMBER.fullmatch(text) else text)
