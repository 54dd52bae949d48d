"""Give mutated messages of the codec a valid checksum and valid sizes, to reach the code behind these checks."""

from __future__ import annotations

import struct
from collections.abc import Callable

import google_crc32c
import zstandard

_FRAME_MAGIC = b"\x28\xb5\x2f\xfd"
_SIZE = struct.Struct("<I")
_BODY_SIZE_OFFSETS = {b"GLSB": 19, b"GLFS": 10}
"""Where the header of each format has the number of bytes of its body."""
_MAX_BODY_BYTES = 1 << 20


def with_checksum(message: bytes) -> bytes:
    """Return the message with the CRC32C of what precedes it as its last four bytes."""
    return message[: -_SIZE.size] + _SIZE.pack(google_crc32c.value(message[: -_SIZE.size]))


def change_body(message: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Return the message with its body unpacked, changed and packed again; unchanged if it has no intact body."""
    start = message.find(_FRAME_MAGIC)
    offset = _BODY_SIZE_OFFSETS.get(message[:4])
    if start < 0 or offset is None:
        return message
    unpacker = zstandard.ZstdDecompressor().decompressobj()
    try:
        if zstandard.get_frame_parameters(message[start:]).content_size > _MAX_BODY_BYTES:
            return message
        body = unpacker.decompress(message[start:])
    except zstandard.ZstdError:
        return message
    rest = unpacker.unused_data
    frame_bytes = len(message) - start - len(rest)
    frame = zstandard.ZstdCompressor(level=1).compress(change(body))
    head = bytearray(message[:start])
    if head[-_SIZE.size :] == _SIZE.pack(frame_bytes):
        # the body of a quantised subset begins with the size of its frame
        head[-_SIZE.size :] = _SIZE.pack(len(frame))
    body_bytes = _SIZE.unpack_from(head, offset)[0] + len(frame) - frame_bytes
    _SIZE.pack_into(head, offset, body_bytes & 0xFFFFFFFF)
    return with_checksum(bytes(head) + frame + rest)
