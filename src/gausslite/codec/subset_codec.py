"""Encode an agent's voxel updates as one self-contained message: header, names, body, CRC32C.

    header   "GLSB" | u16 version | u8 coding | u8 kappa bytes (1 2 4) | u8 target bytes (1 2) | u8 coarse bits
             | u8 scale code | u32 voxels | u32 Gaussians | u32 body bytes | f64 voxel size | u64 message_seq
             | u64 update_seq | u8 agent bytes | u8 session bytes
    names    agent id, session id (UTF-8)
    body     one zstd frame with the columns, and bit fields (`body.py`)
    trailer  u32 CRC32C of everything before it

Numbers are little-endian. The counts determine the size of the columns, so a message with wrong sizes is refused before
memory is allocated.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import google_crc32c
import numpy as np

from gausslite.codec.body import CODERS, VOXEL_BYTES, BodyLayout, SubsetCoding, require_encodable
from gausslite.codec.columns import MAX_COARSE_BITS, PositionPrecision
from gausslite.codec.encoded_voxels import CODES, VOXELS, EncodedSubset
from gausslite.domain.errors import ChecksumError, CodecError, GaussLiteError, InvalidInputError
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid

MAX_SUBSET_BYTES = 1 << 20
VERSION = 2
_MAGIC = b"GLSB"
_HEADER = struct.Struct("<4sHBBBBBIIIdQQBB")
_TRAILER = struct.Struct("<I")
_MAX_NAME_BYTES = 255
_FRAME_BYTES = 256
_Header = namedtuple(
    "_Header",
    "magic version coding kappa_bytes target_bytes coarse_bits scale_code voxels gaussians body_bytes size_m "
    "message_seq update_seq agent_bytes session_bytes",
)


@dataclass(frozen=True, slots=True)
class CodecLimits:
    """Upper limits of one message that a receiver decodes."""

    max_bytes: int = MAX_SUBSET_BYTES
    max_voxels: int = 200_000
    max_gaussians: int = 200_000


DEFAULT_LIMITS = CodecLimits()


def encode_subset(subset: RoiSubset, grid: VoxelGrid, coding: SubsetCoding = SubsetCoding.QUANTISED) -> bytes:
    """Encode the subset; the same subset always gives the same bytes.

    QUANTISED sorts the Gaussians of a voxel by position. Raises InvalidInputError if a value is not finite or out of
    range, or a mean lies outside its voxel.
    """
    batch = subset.batch
    require_encodable(batch.gaussians)
    layout = BodyLayout.of(batch, PositionPrecision.of(len(batch.gaussians), int((batch.counts > 0).sum()), grid))
    body = CODERS[coding].encode(batch, grid, layout)
    agent, session = _name_bytes("agent_id", subset.agent_id), _name_bytes("session_id", subset.session_id)
    precision, of_message = layout.precision, (grid.size_m, subset.message_seq, subset.update_seq)
    header = _Header(
        *(_MAGIC, VERSION, coding, layout.kappa_bytes, layout.target_bytes, *precision),
        *(layout.voxels, layout.gaussians, len(body), *of_message, len(agent), len(session)),
    )
    message: bytes = _HEADER.pack(*header) + agent + session + body
    return message + _TRAILER.pack(google_crc32c.value(message))


def decode_subset(data: bytes, limits: CodecLimits = DEFAULT_LIMITS) -> tuple[RoiSubset, VoxelGrid]:
    """Decode a message; returns the subset and the grid of its voxels.

    Raises CodecError if the bytes are not a valid message or exceed the limits, ChecksumError if they are damaged.
    """
    stored, session_id, grid = _decode(data, limits, stated_sums=True)
    with _codec_errors():
        batch = stored.voxels.batch()
        return RoiSubset(stored.agent_id, session_id, stored.message_seq, stored.update_seq, batch), grid


def unpack_subset(data: bytes, limits: CodecLimits = DEFAULT_LIMITS) -> tuple[EncodedSubset, VoxelGrid]:
    """Check a message and return it as a store keeps it, without decoding its Gaussians. Raises as decode_subset.

    Σkappa is computed from the Gaussians (Sec. III-E), whatever the message states.
    """
    stored, _, grid = _decode(data, limits, stated_sums=False)
    return stored, grid


def declared_bytes(data: bytes) -> int:
    """Return the size of a message's voxels and Gaussians in a store, as its header declares it, within the limits."""
    if len(data) < _HEADER.size:
        return 0
    header, limits = _Header(*_HEADER.unpack_from(data)), DEFAULT_LIMITS
    voxels, gaussians = min(header.voxels, limits.max_voxels), min(header.gaussians, limits.max_gaussians)
    return int(voxels * VOXELS.itemsize + gaussians * CODES.itemsize)


def _decode(data: bytes, limits: CodecLimits, stated_sums: bool) -> tuple[EncodedSubset, str, VoxelGrid]:
    header = _checked_header(data, limits)
    names_start, body_start = _HEADER.size, _HEADER.size + header.agent_bytes + header.session_bytes
    precision = PositionPrecision(header.coarse_bits, header.scale_code)
    layout = BodyLayout(header.voxels, header.gaussians, header.kappa_bytes, header.target_bytes, precision)
    body = data[body_start : -_TRAILER.size]
    with _codec_errors():
        grid = VoxelGrid(header.size_m)
        voxels = CODERS[header.coding].decode(body, grid, layout, header.update_seq, stated_sums)
        names = data[names_start:body_start]
        agent_id, session_id = names[: header.agent_bytes].decode(), names[header.agent_bytes :].decode()
        return EncodedSubset(agent_id, header.message_seq, header.update_seq, voxels), session_id, grid


@contextmanager
def _codec_errors() -> Iterator[None]:
    try:
        yield
    except CodecError:
        raise
    except (GaussLiteError, UnicodeDecodeError) as error:
        raise CodecError(f"subset: {error}") from error


def split_batch(
    batch: VoxelBatch, max_bytes: int = MAX_SUBSET_BYTES, coding: SubsetCoding = SubsetCoding.QUANTISED
) -> list[VoxelBatch]:
    """Split a batch at voxel boundaries into parts whose messages have at most max_bytes, even if incompressible.

    A voxel too large for one message keeps its most opaque Gaussians; its Σkappa stays the total of all.
    """
    capacity = (max_bytes - _HEADER.size - _TRAILER.size - 2 * _MAX_NAME_BYTES - _FRAME_BYTES) * 255 // 256
    gaussian_bytes = CODERS[coding].gaussian_bytes
    max_count = (capacity - VOXEL_BYTES) // gaussian_bytes
    if max_count < 1:
        raise InvalidInputError(f"max_bytes: expected at least 1100, so that a Gaussian fits, got {max_bytes}")
    batch = _limit_counts(batch, max_count)
    costs = batch.counts.astype(np.int64) * gaussian_bytes + VOXEL_BYTES
    parts, start, size = [], 0, 0
    for i, cost in enumerate(costs.tolist()):
        if size + cost > capacity:
            parts.append(_slice(batch, start, i))
            start, size = i, 0
        size += cost
    return [*parts, _slice(batch, start, len(batch))] if len(batch) else []


def _checked_header(data: bytes, limits: CodecLimits) -> _Header:
    """Return the header of a whole message within the limits. Raises CodecError, ChecksumError."""
    if len(data) > limits.max_bytes:
        raise CodecError(f"subset: expected at most {limits.max_bytes} bytes, got {len(data)}")
    if len(data) < _HEADER.size + _TRAILER.size:
        raise CodecError(f"subset: expected at least {_HEADER.size + _TRAILER.size} bytes, got {len(data)}")
    header = _Header(*_HEADER.unpack_from(data))
    magic, version = header[:2]
    if magic != _MAGIC or version != VERSION:
        raise CodecError(f"subset: expected {_MAGIC!r} version {VERSION}, got {magic!r} version {version}")
    if google_crc32c.value(data[: -_TRAILER.size]) != _TRAILER.unpack_from(data, len(data) - _TRAILER.size)[0]:
        raise ChecksumError("subset: CRC32C does not match; the message was damaged")
    if header.coding not in CODERS:
        raise CodecError(f"subset: expected coding 0 or 1, got {header.coding}")
    if header.kappa_bytes not in (1, 2, 4) or header.target_bytes not in (1, 2):
        raise CodecError(f"subset: unknown column widths kappa {header.kappa_bytes}, target {header.target_bytes}")
    if header.coarse_bits > MAX_COARSE_BITS:
        raise CodecError(f"subset: expected at most {MAX_COARSE_BITS} coarse bits, got {header.coarse_bits}")
    if header.voxels > limits.max_voxels or header.gaussians > limits.max_gaussians:
        raise CodecError(
            f"subset: expected at most {limits.max_voxels} voxels and {limits.max_gaussians} Gaussians, "
            f"got {header.voxels} and {header.gaussians}"
        )
    size = _HEADER.size + header.agent_bytes + header.session_bytes + header.body_bytes + _TRAILER.size
    if size != len(data):
        raise CodecError(f"subset: declares {size} bytes, got {len(data)}")
    return header


def _name_bytes(name: str, value: str) -> bytes:
    data = value.encode()
    if len(data) > _MAX_NAME_BYTES:
        raise InvalidInputError(f"subset {name}: expected at most {_MAX_NAME_BYTES} bytes, got {len(data)}")
    return data


def _slice(batch: VoxelBatch, start: int, stop: int) -> VoxelBatch:
    rows, part = np.arange(batch.offsets[start], batch.offsets[stop]), slice(start, stop)
    return VoxelBatch(batch.keys[part], batch.kappa_sums[part], batch.counts[part], batch.gaussians.take(rows))


def _limit_counts(batch: VoxelBatch, max_count: int) -> VoxelBatch:
    keep = np.ones(len(batch.gaussians), np.bool_)
    for i in np.flatnonzero(batch.counts > max_count):
        begin, end = batch.offsets[i], batch.offsets[i + 1]
        faintest = np.argsort(-batch.gaussians.opacities[begin:end], kind="stable")[max_count:]
        keep[begin + faintest] = False
    if keep.all():
        return batch
    counts = np.minimum(batch.counts, max_count).astype(np.uint32)
    return VoxelBatch(batch.keys, batch.kappa_sums, counts, batch.gaussians.take(keep))
