"""One posed RGB-D image, validated on construction, with its colours, depth jumps and encoded sizes."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.checks import require_types, require_whole
from gausslite.domain.errors import InvalidInputError, PoseError
from gausslite.domain.pose import require_rigid

_MIN_RELATIVE_JUMP = 0.04
_COLOUR_SAMPLES, _ONE_COLOUR_LEVELS, _ONE_COLOUR_SHARE = 1200, 4, 0.95
"""An image of one colour has this share of its pixels within so many levels of the median. Images of real recordings
and simulated homes have at most 0.4."""
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_LATE_IN_A_ROW = 5
MAX_DEPTH_M = 65.535
"""Farthest depth on the wire; no sensor measures a room beyond it."""
_FAR_SHARE = 0.9
NO_DEPTH, ONE_COLOUR = "no pixel has a depth reading", "the colour image has one colour"
TOO_FAR = "depth lies beyond 65.5 m, as millimetres that are read as metres do"
MAX_COORDINATE_M = 10_000.0
"""Farther from the world's origin, float32 no longer resolves a millimetre, and voxel keys overflow."""
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
# start-of-frame markers contain the size; C4, C8 and CC are tables
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def without_depth_edges(depth_m: Float32[ndarray, "h w"], distance_px: int) -> Float32[ndarray, "h w"]:
    """Return a copy with depth 0 up to distance_px from a jump; with distance 0 the image itself.

    A jump is where measured depths of a pixel and its eight neighbours differ by more than 4 % of the pixel's. Sensors
    err there by centimetres to metres: the foreground is measured too large, and registration shifts its border.
    """
    if distance_px < 1:
        return depth_m
    measured = depth_m > 0
    farthest = cv2.dilate(depth_m, _NEIGHBOURS)
    nearest = cv2.erode(np.where(measured, depth_m, np.float32(np.inf)), _NEIGHBOURS)
    jumps = measured & (farthest - nearest > np.float32(_MIN_RELATIVE_JUMP) * depth_m)
    side = 2 * distance_px - 1
    near_jumps = cv2.dilate(jumps.view(np.uint8), np.ones((side, side), np.uint8))
    return np.where(near_jumps > 0, np.float32(0.0), depth_m)


class ClockJumps:
    """Distinguishes a clock that was set back from stamps that arrive out of order.

    The clock has jumped if a stamp is more than max_late_s before the latest one, or the last of five ascending ones
    before it: a playback began again, a simulator was reset, or a stamp was of the future.
    """

    def __init__(self, max_late_s: float = 1.5) -> None:
        self._max_late_ns = round(max_late_s * 1e9)
        self._late_ns: list[int] = []

    def has_jumped(self, time_ns: int, latest_ns: int) -> bool:
        """Return whether the clock has jumped from the latest stamp to this one. Call it for each stamp."""
        if time_ns > latest_ns or (self._late_ns and time_ns <= self._late_ns[-1]):
            self._late_ns.clear()
        if time_ns <= latest_ns:
            self._late_ns.append(time_ns)
        has_jumped = latest_ns - time_ns > self._max_late_ns or len(self._late_ns) >= _LATE_IN_A_ROW
        if has_jumped:
            self.reset()
        return has_jumped

    def reset(self) -> None:
        """Forget the late stamps."""
        self._late_ns.clear()


def with_filled_depth(depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return a copy where blocks of 4x4 pixels without a measurement have a depth; without such blocks the image.

    It is the largest depth measured in the smallest block of 8x8, 16x16, 32x32, ... pixels around them that has a
    measurement: what is placed there hides no surface that was measured. All pixels stay 0 if none is measured.
    Single pixels without a measurement stay 0 too; what is placed at their neighbours covers them.
    """
    levels = [_block_maxima(_block_maxima(depth_m))]
    if levels[0].all():
        return depth_m
    while not levels[-1].all() and levels[-1].size > 1:
        levels.append(_block_maxima(levels[-1]))
    filled = levels[-1]
    for finer in reversed(levels[:-1]):
        filled = np.where(finer > 0, finer, _repeated(filled, 2, finer.shape))
    unmeasured = np.where(levels[0] > 0, np.float32(0.0), filled)
    result: Float32[ndarray, "h w"] = np.maximum(depth_m, _repeated(unmeasured, 4, depth_m.shape))
    return result


def _block_maxima(image: Float32[ndarray, "h w"]) -> Float32[ndarray, "bh bw"]:
    """Return the maxima of the blocks of 2x2 pixels."""
    padded = np.pad(image, [(0, side % 2) for side in image.shape])
    quarters = [padded[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    maxima: Float32[ndarray, "bh bw"] = np.maximum.reduce(quarters)
    return maxima


def _repeated(blocks: Float32[ndarray, "bh bw"], times: int, shape: tuple[int, ...]) -> Float32[ndarray, "h w"]:
    """Return an image of this shape where each block's value is repeated along both axes."""
    image: Float32[ndarray, "h w"] = np.repeat(np.repeat(blocks, times, axis=0), times, axis=1)
    return image[: shape[0], : shape[1]]


def is_too_far(depth_m: Float32[ndarray, "h w"]) -> bool:
    """True if nearly all readings are farther than any sensor measures, so that their unit is another one."""
    measured, far = np.count_nonzero(depth_m), np.count_nonzero(depth_m >= np.float32(MAX_DEPTH_M))
    return bool(far > _FAR_SHARE * measured)


class FrameId(NamedTuple):
    """Identifies a captured frame, whatever becomes of its pose and pixels. Clocks restart, so times may repeat."""

    frame_index: int
    capture_time_ns: int

    @property
    def number(self) -> int:
        """The id as one number of 63 bits, for sets of views in saved states."""
        return (self.frame_index & 0x7FFFFFFF) << 32 | zlib.crc32(struct.pack("<q", self.capture_time_ns))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A colour and depth image with its camera and pose.

    depth_m is the distance along the optical axis in metres, 0 where the sensor had no return.
    T_world_camera uses OpenCV axes (x right, y down, z forward); its position is within 10 km of the world's origin
    along each axis. motion: the camera's motion while the image was exposed, with T_world_camera the pose at the middle
    row's time; None for an image of a camera at rest. recorded_rgb: the same image before it was made smaller, for
    detectors; None if it never was. left_out: pixels that are neither seeded nor trained, None without any. Raises
    ShapeError, PoseError, InvalidInputError.
    """

    index: int  # number in the sequence
    capture_time_ns: int  # of the sensor's clock
    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    motion: CameraMotion | None = None
    recorded_rgb: UInt8[ndarray, "hr wr 3"] | None = None
    left_out: Bool[ndarray, "h w"] | None = None

    def __post_init__(self) -> None:
        require_whole("frame index", self.index)
        require_whole("frame capture_time_ns", self.capture_time_ns)
        require_types(camera=(self.camera, Camera))
        size = (self.camera.height_px, self.camera.width_px)
        require_array("frame rgb", self.rgb, (*size, 3), np.uint8)
        require_array("frame depth_m", self.depth_m, size, np.float32)
        if self.left_out is not None:
            require_array("frame left_out", self.left_out, size, np.bool_)
        require_array("frame T_world_camera", self.T_world_camera, (4, 4), np.float64)
        require_rigid("frame T_world_camera", self.T_world_camera)
        if np.abs(self.T_world_camera[:3, 3]).max() > MAX_COORDINATE_M:
            raise PoseError(
                f"frame T_world_camera: expected a camera within {MAX_COORDINATE_M:g} m of the world's origin, "
                f"got one at {self.T_world_camera[:3, 3].tolist()}; choose an origin near the robot"
            )
        if not np.isfinite(self.depth_m).all() or (self.depth_m < 0).any():
            raise InvalidInputError("frame depth_m: expected finite values of at least 0 (0 = no return)")

    def without(self, pixels: Bool[ndarray, "h w"]) -> Frame:
        """Return the frame with these pixels left out too, and without depth there."""
        left_out = pixels if self.left_out is None else self.left_out | pixels
        return replace(self, depth_m=np.where(pixels, np.float32(0), self.depth_m), left_out=left_out)

    @property
    def id(self) -> FrameId:
        """What identifies the frame."""
        return FrameId(self.index, self.capture_time_ns)

    @property
    def sharpest_rgb(self) -> UInt8[ndarray, "hs ws 3"]:
        """The image with the most pixels: as recorded if it was made smaller."""
        return self.rgb if self.recorded_rgb is None else self.recorded_rgb

    @property
    def has_depth(self) -> bool:
        """False if no pixel has a depth."""
        return bool((self.depth_m > 0).any())

    @property
    def defect(self) -> str:
        """Why the frame can be neither mapped nor scored; empty if it can.

        A camera that drops out, is covered or overexposed gives an image of one colour, which would be trained.
        """
        if not self.has_depth:
            return NO_DEPTH
        if is_too_far(self.depth_m):
            return TOO_FAR
        step = max(1, math.isqrt(self.depth_m.size // _COLOUR_SAMPLES))
        colours = self.rgb[::step, ::step].reshape(-1, 3)
        median = np.median(colours, axis=0)
        near = (np.abs(colours - median) <= _ONE_COLOUR_LEVELS).all(axis=1)
        return ONE_COLOUR if near.mean() >= _ONE_COLOUR_SHARE else ""


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return the declared (width, height) in pixels of a PNG or JPEG; None for other bytes."""
    if data.startswith(_PNG) and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return int(width), int(height)
    if not data.startswith(_JPEG):
        return None
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker in _JPEG_SIZE_MARKERS:
            height, width = struct.unpack_from(">HH", data, offset + 5)
            return int(width), int(height)
        # repeated FF bytes are padding before a marker
        offset += 1 if marker == 0xFF else 2 + struct.unpack_from(">H", data, offset + 2)[0]
    return None


def has_whole_chunks(data: bytes) -> bool:
    """Return False for a PNG with a chunk that ends outside the file: decoders allocate the length that it declares."""
    offset = len(_PNG)
    while data.startswith(_PNG) and offset + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        offset += 12 + length
        if kind == b"IEND":
            break
    return offset <= len(data)
