"""Check the sizes that an encoded image declares, before memory is allocated for them."""

from __future__ import annotations

import struct

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
# start-of-frame markers contain the size; C4, C8 and CC are tables
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


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
