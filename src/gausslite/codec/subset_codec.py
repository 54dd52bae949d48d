"""Encode an agent's voxel updates as one self-contained message: little-endian columns, zstd, CRC32C.

    header   "GLSB" | u16 version | u8 kappa bytes (1 2 4) | u8 target bytes (1 2) | u32 voxels | u32 Gaussians
             | u32 body bytes | f64 voxel size | u64 message_seq | u64 update_seq | u8 agent bytes | u8 session bytes
    names    agent id, session id (UTF-8)
    body     one zstd frame over byte-shuffled columns: keys i64, kappa sums u64, counts u32 per voxel; then means,
             scales, quats, opacities, rgb (see columns.py), kappa, target, active (bits) per Gaussian
    trailer  u32 CRC32C of everything before it

The counts determine the size of the columns, so a message with wrong sizes is refused before memory is allocated.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import google_crc32c
import numpy as np
import zstandard
from numpy.typing import NDArray

from gausslite.codec import columns
from gausslite.domain.arrays import require_finite
from gausslite.domain.errors import ChecksumError, CodecError, GaussLiteError, InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid

MAX_SUBSET_BYTES = 1 << 20
_MAGIC, _VERSION, _ZSTD_LEVEL = b"GLSB", 1, 3
_HEADER = struct.Struct("<4sHBBIIIdQQBB")
_TRAILER = struct.Struct("<I")
_VOXEL_BYTES = 8 + 8 + 4
_GAUSSIAN_BYTES = 6 + 3 + 4 + 1 + 3
_MAX_NAME_BYTES = 255
_MAX_GAUSSIAN_BYTES = _GAUSSIAN_BYTES + 4 + 2 + 1


@dataclass(frozen=True, slots=True)
class CodecLimits:
    """Upper limits of one message that a receiver decodes."""

    max_bytes: int = MAX_SUBSET_BYTES
    max_voxels: int = 200_000
    max_gaussians: int = 200_000


DEFAULT_LIMITS = CodecLimits()


@dataclass(frozen=True, slots=True)
class _Layout:
    """The columns of a body; their sizes follow from the counts."""

    voxels: int
    gaussians: int
    kappa_bytes: int
    target_bytes: int

    def columns(self) -> list[tuple[str, tuple[int, ...]]]:
        """Return the (little-endian type, shape) of each column, in order."""
        v, n = self.voxels, self.gaussians
        per_voxel: list[tuple[str, tuple[int, ...]]] = [("<i8", (v,)), ("<u8", (v,)), ("<u4", (v,))]
        return [
            *per_voxel,
            *(("<u2", (n, 3)), ("<u1", (n, 3)), ("<u4", (n,)), ("<u1", (n,)), ("<u1", (n, 3))),
            *((f"<u{self.kappa_bytes}", (n,)), (f"<i{self.target_bytes}", (n,)), ("<u1", ((n + 7) // 8,))),
        ]

    @property
    def size(self) -> int:
        """Bytes of the decompressed body."""
        per_gaussian = _GAUSSIAN_BYTES + self.kappa_bytes + self.target_bytes
        return self.voxels * _VOXEL_BYTES + self.gaussians * per_gaussian + (self.gaussians + 7) // 8


def encode_subset(subset: RoiSubset, grid: VoxelGrid) -> bytes:
    """Encode the subset; the same subset always gives the same bytes.

    Raises InvalidInputError if a value is not finite or out of range, or a mean lies outside its voxel.
    """
    batch, n = subset.batch, len(subset.batch.gaussians)
    _require_encodable(batch.gaussians)
    agent, session = (_name_bytes(name, value) for name, value in _names(subset))
    layout = _Layout(
        len(batch), n, _width(int(batch.gaussians.kappa.max(initial=0)), 8), _target_width(batch.gaussians.target)
    )
    packed = b"".join(
        _shuffle(np.ascontiguousarray(column, dtype))
        for column, (dtype, _) in zip(_quantise(batch, grid), layout.columns(), strict=True)
    )
    body = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(packed)
    header = _HEADER.pack(
        *(_MAGIC, _VERSION, layout.kappa_bytes, layout.target_bytes, layout.voxels, layout.gaussians, len(body)),
        *(grid.size_m, subset.message_seq, subset.update_seq, len(agent), len(session)),
    )
    message = header + agent + session + body
    return message + _TRAILER.pack(google_crc32c.value(message))


def decode_subset(data: bytes, limits: CodecLimits = DEFAULT_LIMITS) -> tuple[RoiSubset, VoxelGrid]:
    """Decode a message; returns the subset and the grid of its voxels.

    Raises CodecError if the bytes are not a valid message or exceed the limits, ChecksumError if they are damaged.
    """
    layout, fields, names, body = _open_envelope(data, limits)
    size_m, message_seq, update_seq = fields
    try:
        grid = VoxelGrid(size_m)
        batch = _dequantise(_unpack(body, layout), grid)
        return RoiSubset(names[0].decode(), names[1].decode(), message_seq, update_seq, batch), grid
    except CodecError:
        raise
    except (GaussLiteError, UnicodeDecodeError) as error:
        raise CodecError(f"subset: {error}") from error


def split_batch(batch: VoxelBatch, max_bytes: int = MAX_SUBSET_BYTES) -> list[VoxelBatch]:
    """Split a batch at voxel boundaries into parts whose messages have at most max_bytes, even if incompressible.

    A voxel too large for one message keeps its most opaque Gaussians; its Σkappa stays the total of all.
    """
    capacity = (max_bytes - _HEADER.size - _TRAILER.size - 2 * _MAX_NAME_BYTES - 64) * 255 // 256
    max_count = (capacity - _VOXEL_BYTES) // _MAX_GAUSSIAN_BYTES
    if max_count < 1:
        raise InvalidInputError(f"max_bytes: expected at least 1024, so that a Gaussian fits, got {max_bytes}")
    batch = _limit_counts(batch, max_count)
    costs = batch.counts.astype(np.int64) * _MAX_GAUSSIAN_BYTES + _VOXEL_BYTES
    parts, start, size = [], 0, 0
    for i, cost in enumerate(costs.tolist()):
        if size + cost > capacity:
            parts.append(_slice(batch, start, i))
            start, size = i, 0
        size += cost
    return [*parts, _slice(batch, start, len(batch))] if len(batch) else []


def _open_envelope(
    data: bytes, limits: CodecLimits
) -> tuple[_Layout, tuple[float, int, int], tuple[bytes, bytes], bytes]:
    if len(data) > limits.max_bytes:
        raise CodecError(f"subset: expected at most {limits.max_bytes} bytes, got {len(data)}")
    if len(data) < _HEADER.size + _TRAILER.size:
        raise CodecError(f"subset: expected at least {_HEADER.size + _TRAILER.size} bytes, got {len(data)}")
    header = _HEADER.unpack_from(data)
    magic, version, kappa_bytes, target_bytes, voxels, gaussians, body_bytes, *fields, agent, session = header
    if magic != _MAGIC or version != _VERSION:
        raise CodecError(f"subset: expected {_MAGIC!r} version {_VERSION}, got {magic!r} version {version}")
    if google_crc32c.value(data[: -_TRAILER.size]) != _TRAILER.unpack_from(data, len(data) - _TRAILER.size)[0]:
        raise ChecksumError("subset: CRC32C does not match; the message was damaged")
    if kappa_bytes not in (1, 2, 4) or target_bytes not in (1, 2):
        raise CodecError(f"subset: unknown column widths kappa {kappa_bytes}, target {target_bytes}")
    if voxels > limits.max_voxels or gaussians > limits.max_gaussians:
        raise CodecError(
            f"subset: expected at most {limits.max_voxels} voxels and {limits.max_gaussians} Gaussians, "
            f"got {voxels} and {gaussians}"
        )
    names_end = _HEADER.size + agent + session
    if names_end + body_bytes + _TRAILER.size != len(data):
        raise CodecError(f"subset: declares {names_end + body_bytes + _TRAILER.size} bytes, got {len(data)}")
    names = data[_HEADER.size : _HEADER.size + agent], data[_HEADER.size + agent : names_end]
    return (
        _Layout(voxels, gaussians, kappa_bytes, target_bytes),
        (fields[0], fields[1], fields[2]),
        names,
        data[names_end : -_TRAILER.size],
    )


def _unpack(body: bytes, layout: _Layout) -> list[NDArray[Any]]:
    try:
        frame = zstandard.get_frame_parameters(body)
        if frame.content_size != layout.size or frame.window_size > max(layout.size, 1 << 10):
            raise CodecError(f"subset: expected a body of {layout.size} bytes, got {frame.content_size}")
        raw = zstandard.ZstdDecompressor().decompress(body, max_output_size=layout.size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(f"subset: body is not one zstd frame: {error}") from error
    out, start = [], 0
    for dtype, shape in layout.columns():
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        out.append(_unshuffle(raw[start : start + size], dtype, shape))
        start += size
    return out


def _quantise(batch: VoxelBatch, grid: VoxelGrid) -> list[NDArray[Any]]:
    g = batch.gaussians
    voxel = np.repeat(grid.indices(batch.keys), batch.counts, axis=0)
    return [
        *(batch.keys, batch.kappa_sums, batch.counts),
        columns.encode_means(g.means_m, voxel, grid),
        columns.encode_scales(g.scales_m),
        columns.encode_quats(g.quats_wxyz),
        columns.encode_opacities(g.opacities),
        columns.encode_rgb(g.rgb),
        *(g.kappa, g.target, np.packbits(g.active, bitorder="little")),
    ]


def _dequantise(raw: list[NDArray[Any]], grid: VoxelGrid) -> VoxelBatch:
    keys, kappa_sums, counts, means, scales, quats, opacities, rgb, kappa, target, active = raw
    n = len(means)
    if int(counts.sum(dtype=np.uint64)) != n:
        raise CodecError(f"subset: voxel counts sum to {int(counts.sum(dtype=np.uint64))}, expected {n}")
    if (keys < 0).any():
        raise CodecError("subset: expected voxel keys of at least 0, got a negative one")
    voxel = np.repeat(grid.indices(keys), counts, axis=0)
    gaussians = Gaussians(
        columns.decode_means(means, voxel, grid),
        columns.decode_quats(quats),
        columns.decode_scales(scales),
        columns.decode_opacities(opacities),
        columns.decode_rgb(rgb),
        np.unpackbits(active, count=n, bitorder="little").astype(np.bool_),
        kappa.astype(np.uint32),
        target.astype(np.int16),
    )
    return VoxelBatch(keys, kappa_sums, counts, gaussians)


def _require_encodable(gaussians: Gaussians) -> None:
    for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb"):
        require_finite(f"voxel batch {name}", getattr(gaussians, name))
    if (gaussians.scales_m <= 0).any():
        raise InvalidInputError("voxel batch scales_m: expected positive scales, got zero or less")
    if (gaussians.opacities < 0).any() or (gaussians.opacities > 1).any():
        raise InvalidInputError("voxel batch opacities: expected 0 to 1, got one outside")
    if (gaussians.quats_wxyz == 0).all(axis=1).any():
        raise InvalidInputError("voxel batch quats_wxyz: expected rotations, got a zero quaternion")


def _names(subset: RoiSubset) -> tuple[tuple[str, str], tuple[str, str]]:
    return ("agent_id", subset.agent_id), ("session_id", subset.session_id)


def _name_bytes(name: str, value: str) -> bytes:
    data = value.encode()
    if len(data) > _MAX_NAME_BYTES:
        raise InvalidInputError(f"subset {name}: expected at most {_MAX_NAME_BYTES} bytes, got {len(data)}")
    return data


def _width(largest: int, bits: int) -> int:
    return 1 if largest < 1 << bits else 2 if largest < 1 << (bits + 8) else 4


def _target_width(target: NDArray[np.int16]) -> int:
    return 1 if int(target.min(initial=0)) >= -128 and int(target.max(initial=0)) <= 127 else 2


def _shuffle(column: NDArray[Any]) -> bytes:
    """Return all first bytes, then all second bytes, and so on: similar neighbouring bytes compress better."""
    return column.view(np.uint8).reshape(-1, column.itemsize).T.tobytes()


def _unshuffle(raw: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    planes = np.frombuffer(raw, np.uint8).reshape(np.dtype(dtype).itemsize, -1)
    return np.ascontiguousarray(planes.T).reshape(-1).view(dtype).reshape(shape)


def _slice(batch: VoxelBatch, start: int, stop: int) -> VoxelBatch:
    rows = np.arange(batch.offsets[start], batch.offsets[stop])
    return VoxelBatch(
        batch.keys[start:stop], batch.kappa_sums[start:stop], batch.counts[start:stop], batch.gaussians.take(rows)
    )


def _limit_counts(batch: VoxelBatch, max_count: int) -> VoxelBatch:
    if not (batch.counts > max_count).any():
        return batch
    keep = np.ones(len(batch.gaussians), np.bool_)
    for i in np.flatnonzero(batch.counts > max_count):
        begin, end = batch.offsets[i], batch.offsets[i + 1]
        faintest = np.argsort(-batch.gaussians.opacities[begin:end], kind="stable")[max_count:]
        keep[begin + faintest] = False
    return VoxelBatch(
        batch.keys, batch.kappa_sums, np.minimum(batch.counts, max_count).astype(np.uint32), batch.gaussians.take(keep)
    )
