"""Encode free space at two bits a voxel before compression: blocks of 512 voxels, zstd, CRC32C.

    header   "GLFS" | u16 version | u32 blocks | u32 body bytes | f64 voxel size
    body     one zstd frame: block keys i64, then 128 bytes a block, four voxels a byte, the first in the low bits
    trailer  u32 CRC32C of everything before it

The number of blocks determines the size of the body, so a wrong message is refused before memory is allocated.
"""

from __future__ import annotations

import struct

import google_crc32c
import numpy as np
import zstandard

from gausslite.domain.errors import ChecksumError, CodecError, InvalidInputError
from gausslite.domain.free_space import BLOCK_VOXELS, FreeSpace
from gausslite.domain.voxels import VoxelGrid

MAX_FREE_SPACE_BYTES = 1 << 20
MAX_BLOCKS = 20_000
_MAGIC, _VERSION, _ZSTD_LEVEL = b"GLFS", 1, 6
_HEADER = struct.Struct("<4sHIId")
_TRAILER = struct.Struct("<I")
_BLOCK_BYTES = BLOCK_VOXELS // 4


def encode_free_space(free: FreeSpace, grid: VoxelGrid) -> bytes:
    """Return the message. Raises InvalidInputError for too many blocks."""
    if len(free.keys) > MAX_BLOCKS:
        raise InvalidInputError(f"free space: expected at most {MAX_BLOCKS} blocks, got {len(free.keys)}")
    quads = free.counts.reshape(-1, _BLOCK_BYTES, 4)
    packed = quads[..., 0] | quads[..., 1] << 2 | quads[..., 2] << 4 | quads[..., 3] << 6
    body = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(
        free.keys.astype("<i8").tobytes() + packed.astype(np.uint8).tobytes()
    )
    message = _HEADER.pack(_MAGIC, _VERSION, len(free.keys), len(body), grid.size_m) + body
    return message + _TRAILER.pack(google_crc32c.value(message))


def decode_free_space(data: bytes, max_bytes: int = MAX_FREE_SPACE_BYTES) -> tuple[FreeSpace, VoxelGrid]:
    """Return free space and its voxel grid. Raises CodecError, ChecksumError, InvalidInputError."""
    if not _HEADER.size + _TRAILER.size <= len(data) <= max_bytes:
        raise CodecError(f"free space: expected {_HEADER.size + _TRAILER.size} to {max_bytes} bytes, got {len(data)}")
    magic, version, blocks, body_bytes, size_m = _HEADER.unpack_from(data)
    if magic != _MAGIC or version != _VERSION:
        raise CodecError(f"free space: expected version {_VERSION} of the codec, got other bytes")
    if blocks > MAX_BLOCKS or _HEADER.size + body_bytes + _TRAILER.size != len(data):
        raise CodecError(f"free space: expected at most {MAX_BLOCKS} blocks in {len(data)} bytes, got {blocks}")
    if google_crc32c.value(data[: -_TRAILER.size]) != _TRAILER.unpack_from(data, len(data) - _TRAILER.size)[0]:
        raise ChecksumError("free space: CRC32C does not match; the message was damaged")
    size = blocks * (8 + _BLOCK_BYTES)
    body = data[_HEADER.size : -_TRAILER.size]
    try:
        if zstandard.get_frame_parameters(body).content_size != size:
            raise CodecError(f"free space: expected a body of {size} bytes, got another size")
        raw = zstandard.ZstdDecompressor().decompress(body, max_output_size=max(size, 1))
    except zstandard.ZstdError as error:
        raise CodecError(f"free space: body is not one zstd frame: {error}") from error
    if len(raw) != size:
        raise CodecError(f"free space: expected a body of {size} bytes, got {len(raw)}")
    keys = np.frombuffer(raw, "<i8", blocks).astype(np.int64)
    packed = np.frombuffer(raw, np.uint8, offset=8 * blocks).reshape(blocks, _BLOCK_BYTES)
    counts = np.stack([packed >> shift & 3 for shift in (0, 2, 4, 6)], axis=-1).reshape(blocks, BLOCK_VOXELS)
    if (keys < 0).any():
        raise CodecError("free space: expected block keys of at least 0, got a negative one")
    return FreeSpace(keys, np.ascontiguousarray(counts)), VoxelGrid(size_m)
