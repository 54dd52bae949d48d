"""Encode and decode images: JPEG or PNG colour, 16-bit PNG depth in mm; sizes are checked before decoding."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.image_bytes import has_whole_chunks, image_size

JPEG_QUALITY = 95
PNG_COMPRESSION = 1
"""Level 6 takes three times longer and saves a quarter of the bytes; level 9 takes another ten times longer."""
KEYFRAME_JPEG_QUALITY = 90
KEYFRAME_PNG_COMPRESSION = 6
"""Keyframes are sent once, and compete for a robot's bandwidth."""
_MM_PER_M = 1000.0
_MAX_DEPTH_MM = 65535


def encode_colour(rgb: UInt8[ndarray, "h w 3"], lossless: bool = False, quality: int = JPEG_QUALITY) -> bytes:
    """Encode as PNG if lossless, otherwise as JPEG of this quality."""
    import cv2

    kind, options = (".png", []) if lossless else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(cv2.imencode(kind, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes())


def encode_depth(depth_m: Float32[ndarray, "h w"], compression: int = PNG_COMPRESSION) -> bytes:
    """Encode as 16-bit PNG in millimetres; depth beyond 65.5 m becomes 0 (no return)."""
    import cv2

    depth_mm = np.rint(depth_m.astype(np.float64) * _MM_PER_M)
    depth_mm[depth_mm > _MAX_DEPTH_MM] = 0
    options = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    return bytes(cv2.imencode(".png", depth_mm.astype(np.uint16), options)[1].tobytes())


def encode_mask(mask: Bool[ndarray, "h w"], compression: int = PNG_COMPRESSION) -> bytes:
    """Encode as PNG with one bit a pixel: white where True, otherwise black."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, compression, cv2.IMWRITE_PNG_BILEVEL, 1]
    return bytes(cv2.imencode(".png", mask.astype(np.uint8) * np.uint8(255), options)[1].tobytes())


def decode_mask(data: bytes, width_px: int, height_px: int) -> Bool[ndarray, "h w"]:
    """Decode a mask of exactly this size. Raises InvalidInputError."""
    import cv2

    _require_size("mask", data, width_px, height_px)
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (height_px, width_px) or image.dtype != np.uint8:
        raise InvalidInputError("mask: expected a one-channel PNG of up to 8 bits, got something else")
    return image > 0


def decode_colour(data: bytes, width_px: int, height_px: int) -> UInt8[ndarray, "h w 3"]:
    """Decode colour of exactly this size. Raises InvalidInputError."""
    import cv2

    _require_size("frame colour", data, width_px, height_px)
    image = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape != (height_px, width_px, 3) or image.dtype != np.uint8:
        raise InvalidInputError("frame colour: expected an 8-bit JPEG or PNG, got damaged bytes")
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def decode_depth(data: bytes, width_px: int, height_px: int) -> Float32[ndarray, "h w"]:
    """Decode depth in metres of exactly this size. Raises InvalidInputError."""
    import cv2

    _require_size("frame depth_png", data, width_px, height_px)
    image = _decode(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (height_px, width_px) or image.dtype != np.uint16:
        raise InvalidInputError("frame depth_png: expected a one-channel 16-bit PNG, got something else")
    return (image.astype(np.float64) / _MM_PER_M).astype(np.float32)


def _require_size(name: str, data: bytes, width_px: int, height_px: int) -> None:
    size = image_size(data)
    if size is None:
        raise InvalidInputError(f"{name}: expected a JPEG or PNG, got {len(data)} bytes of something else")
    if size != (width_px, height_px):
        raise InvalidInputError(f"{name}: expected the camera's {width_px}x{height_px}, got {size[0]}x{size[1]}")
    if not has_whole_chunks(data):
        raise InvalidInputError(f"{name}: expected a whole PNG, got damaged bytes: a chunk ends outside of them")


def _decode(data: bytes, flags: int) -> ndarray | None:
    import cv2

    try:
        image: ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
    return image
