"""Encode what stores and spools keep: exact rows of Gaussians, and rows of a voxel.

Gaussians that arrived in quantised messages are stored as the codes of `codec/columns.py`, about 19 bytes each. A row
begins with the voxel size (float64, little-endian), then has one element of CODES per Gaussian. A voxel with any value
that such a row would change has exact rows of 63 bytes instead; the lengths tell the two apart.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64, UInt32
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec import columns
from gausslite.domain.errors import CodecError, InvalidInputError, StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch, VoxelGrid

RECORD = np.dtype(
    [
        ("means_m", "<f4", (3,)),
        ("quats_wxyz", "<f4", (4,)),
        ("scales_m", "<f4", (3,)),
        ("opacities", "<f4"),
        ("rgb", "<f4", (3,)),
        ("active", "?"),
        ("kappa", "<u4"),
        ("target", "<i2"),
    ]
)
"""63 bytes per Gaussian, little-endian, without padding; storing changes no bit."""


def to_records(gaussians: Gaussians) -> NDArray[Any]:
    """Return one packed row per Gaussian, in order."""
    records = np.empty(len(gaussians), RECORD)
    for name in RECORD.names or ():
        records[name] = getattr(gaussians, name)
    return records


def from_bytes(data: bytes) -> Gaussians:
    """Decode packed rows. Raises StorageError if the length is not a multiple of a row."""
    if len(data) % RECORD.itemsize:
        raise StorageError(
            f"stored voxel: expected a multiple of {RECORD.itemsize} bytes, got {len(data)}; the store is damaged"
        )
    records = np.frombuffer(data, RECORD)
    return Gaussians(*(np.ascontiguousarray(records[field.name]) for field in fields(Gaussians)))


CODES = np.dtype(
    [
        ("fractions", "<u2", (3,)),
        ("scales", "u1", (3,)),
        ("quats", "u1", (3,)),
        ("largest_and_opacity", "u1"),
        ("rgb", "u1", (3,)),
        ("active_and_target", "u1"),
        ("kappa", "<u2"),
    ]
)
"""19 bytes per Gaussian, without padding. Two bits for a quaternion's largest component, six for the opacity; one bit
for `active`, seven for the target plus one."""
_SIZE = struct.Struct("<d")
_OPACITY_BITS, _TARGET_BITS = 6, 7
_MAX_TARGET = (1 << _TARGET_BITS) - 2
# a valid element of CODES, in place of a Gaussian that has none
_ANY_CODE = ((0, 0, 0), (0, 0, 0), (128, 128, 128), 0, (0, 0, 0), 0, 0)


def to_stored(batch: VoxelBatch, grid: VoxelGrid | None) -> list[bytes]:
    """Return one row per voxel, empty for a tombstone; grid: that of the messages, None if it is not known."""
    if grid is None:
        return _split(to_records(batch.gaussians), batch.offsets)
    codes = _codes_of(batch, grid)
    unchanged = _same_bits(_decode(batch.keys, batch.counts, codes, grid), batch.gaussians)
    changes = np.concatenate([np.zeros(1, np.int64), np.cumsum(~unchanged)])
    offsets = batch.offsets
    rows = _split(codes, offsets, _SIZE.pack(grid.size_m))
    exact = changes[offsets[1:]] > changes[offsets[:-1]]
    if exact.any():
        records = _split(to_records(batch.gaussians), offsets)
        rows = [
            record if is_exact else row for row, record, is_exact in zip(rows, records, exact.tolist(), strict=True)
        ]
    return rows


def from_stored(keys: Int64[ndarray, " v"], counts: UInt32[ndarray, " v"], rows: Sequence[bytes]) -> Gaussians:
    """Return the Gaussians of these voxels, in order. Raises StorageError for a damaged row."""
    sizes: list[bytes] = []
    for row, count in zip(rows, counts.tolist(), strict=True):
        if not is_stored(row, count):
            raise StorageError(f"stored voxel: expected {count} Gaussians, got {len(row)} bytes; the store is damaged")
        sizes.append(b"" if len(row) == count * RECORD.itemsize else row[: _SIZE.size])
    kinds = sorted({size for size, row in zip(sizes, rows, strict=True) if row})
    if len(kinds) <= 1:
        return _of_one_kind(keys, counts, rows, *kinds)
    # rows of several kinds: decode each kind, then put the voxels in order
    places = {kind: np.array([i for i, size in enumerate(sizes) if size == kind]) for kind in kinds}
    parts = [_of_one_kind(keys[own], counts[own], [rows[i] for i in own], kind) for kind, own in places.items()]
    voxels = np.concatenate([np.repeat(own, counts[own]) for own in places.values()])
    return Gaussians.concatenate(parts).take(np.argsort(voxels, kind="stable"))


def is_stored(row: bytes, count: int) -> bool:
    """Return whether a row has the length of so many Gaussians."""
    return len(row) in (count * RECORD.itemsize, _SIZE.size + count * CODES.itemsize if count else 0)


def _of_one_kind(
    keys: Int64[ndarray, " v"], counts: UInt32[ndarray, " v"], rows: Sequence[bytes], size: bytes = b""
) -> Gaussians:
    """Decode rows that all begin with this voxel size, or that are exact if it is empty."""
    if not size:
        return from_bytes(b"".join(rows))
    codes = np.frombuffer(b"".join(row[_SIZE.size :] for row in rows), CODES)
    try:
        return _decode(keys, counts, codes, VoxelGrid(*_SIZE.unpack(size)))
    except (CodecError, InvalidInputError) as error:
        raise StorageError(f"stored voxel: {error}; the store is damaged") from error


def _split(rows: NDArray[Any], offsets: Int64[ndarray, " v1"], head: bytes = b"") -> list[bytes]:
    data, ends = rows.tobytes(), (offsets * rows.dtype.itemsize).tolist()
    return [head + data[start:end] if end > start else b"" for start, end in itertools.pairwise(ends)]


def _codes_of(batch: VoxelBatch, grid: VoxelGrid) -> NDArray[Any]:
    gaussians = _encodable(batch.gaussians)
    codes = np.empty(len(gaussians), CODES)
    voxel = np.repeat(grid.indices(batch.keys), batch.counts, axis=0)
    codes["fractions"] = columns.fractions_of(gaussians.means_m, voxel, grid)
    codes["scales"] = columns.encode_scales(gaussians.scales_m)
    largest, codes["quats"] = columns.encode_quats(gaussians.quats_wxyz, columns.quat_steps(codes["scales"]))
    codes["largest_and_opacity"] = largest << _OPACITY_BITS | columns.encode_opacities(gaussians.opacities)
    codes["rgb"] = columns.encode_rgb(gaussians.rgb)
    target = np.clip(gaussians.target, -1, _MAX_TARGET) + 1
    codes["active_and_target"] = gaussians.active.astype(np.uint8) << _TARGET_BITS | target.astype(np.uint8)
    codes["kappa"] = np.minimum(gaussians.kappa, np.iinfo(np.uint16).max)
    return codes


def _decode(
    keys: Int64[ndarray, " v"], counts: UInt32[ndarray, " v"], codes: NDArray[Any], grid: VoxelGrid
) -> Gaussians:
    """Return the Gaussians of these codes. Raises CodecError for codes out of range."""
    voxel = np.repeat(grid.indices(keys), counts, axis=0)
    scales, packed, label = codes["scales"], codes["largest_and_opacity"], codes["active_and_target"]
    return Gaussians(
        means_m=columns.points_of(codes["fractions"], voxel, grid),
        quats_wxyz=columns.decode_quats(packed >> _OPACITY_BITS, codes["quats"], columns.quat_steps(scales)),
        scales_m=columns.decode_scales(scales),
        opacities=columns.decode_opacities(packed & (1 << _OPACITY_BITS) - 1),
        rgb=columns.decode_rgb(codes["rgb"]),
        active=(label >> _TARGET_BITS).astype(np.bool_),
        kappa=codes["kappa"].astype(np.uint32),
        target=(label & (1 << _TARGET_BITS) - 1).astype(np.int16) - np.int16(1),
    )


def _encodable(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with another one in place of each that has no code; these are not stored as codes."""
    floats = [getattr(gaussians, name) for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb")]
    if all(np.isfinite(values).all() for values in floats) and gaussians.quats_wxyz.any(axis=1).all():
        return gaussians
    finite = [np.isfinite(values).reshape(len(gaussians), -1).all(axis=1) for values in floats]
    usable = np.logical_and.reduce(finite) & gaussians.quats_wxyz.any(axis=1)
    other = _decode(np.zeros(1, np.int64), np.ones(1, np.uint32), np.array([_ANY_CODE], CODES), VoxelGrid())
    rows = np.where(usable, np.arange(len(gaussians)), len(gaussians))
    return Gaussians.concatenate([gaussians, other]).take(rows)


def _same_bits(first: Gaussians, second: Gaussians) -> Bool[ndarray, " n"]:
    same = np.ones(len(first), np.bool_)
    for field in fields(Gaussians):
        left, right = (np.ascontiguousarray(getattr(voxels, field.name)) for voxels in (first, second))
        row = np.dtype((np.void, left[:1].nbytes or 1))
        same &= left.view(row).ravel() == right.view(row).ravel()
    return same
