"""Keep voxels in rows of a store: the codes of a quantised message as it brought them, or exact records.

    row      f64 voxel size, 0 with exact records | u32 voxels | VOXELS of each voxel | CODES or RECORD of each Gaussian

Numbers are little-endian. A row holds the voxels of one message in one tile, or those that are left of several
messages. Gaussians of quantised messages never become floats on the way into a store: their codes are checked and
copied, 21 bytes each, and become floats when they are read. Lossless messages are stored as exact records of 63 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt32, UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.codec import columns
from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, gather_rows, tiles_of

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

CODES = np.dtype(
    [
        ("fractions", "<u2", (3,)),
        ("scales", "u1", (3,)),
        ("quats", "u1", (3,)),
        ("largest_and_opacity", "u1"),
        ("rgb", "u1", (3,)),
        ("active_and_target", "u1"),
        ("kappa", "<u4"),
    ]
)
"""21 bytes per Gaussian, without padding. Two bits for a quaternion's largest component, six for the opacity; one bit
for `active`, seven for the target plus one."""
OPACITY_BITS, TARGET_BITS = 6, 7
VOXELS = np.dtype([("keys", "<i8"), ("update_seqs", "<u8"), ("kappa_sums", "<u8"), ("counts", "<u4")])
_HEAD = struct.Struct("<dI")


@dataclass(frozen=True, slots=True, eq=False)
class EncodedVoxels:
    """The complete content of each listed voxel, as a row has it.

    gaussians: sorted by voxel, CODES of messages with voxels of size_m metres, or RECORDs, and then size_m is 0.
    """

    voxels: NDArray[Any]  # a VOXELS element each
    gaussians: NDArray[Any]
    size_m: float

    def __len__(self) -> int:
        return len(self.voxels)

    @classmethod
    def exact(cls, batch: VoxelBatch, update_seq: int) -> EncodedVoxels:
        """Return updates of one message that keep every bit of their Gaussians."""
        voxels = voxel_table(batch.keys, update_seq, batch.kappa_sums, batch.counts)
        return cls(voxels, to_records(batch.gaussians), 0.0)

    @classmethod
    def concatenate(cls, parts: Sequence[EncodedVoxels]) -> EncodedVoxels:
        """Return the voxels of all parts, in order; they have one size_m, and there is at least one."""
        if len(parts) == 1:
            return parts[0]
        gaussians = join_elements([part.gaussians for part in parts])
        return cls(join_elements([part.voxels for part in parts]), gaussians, parts[0].size_m)

    @property
    def keys(self) -> Int64[ndarray, " v"]:
        """The key of each voxel."""
        return np.ascontiguousarray(self.voxels["keys"])

    @property
    def counts(self) -> UInt32[ndarray, " v"]:
        """The number of Gaussians of each voxel."""
        return np.ascontiguousarray(self.voxels["counts"])

    def take(self, places: Int64[ndarray, " k"]) -> EncodedVoxels:
        """Return the voxels at these indices, in their order."""
        counts = self.voxels["counts"].astype(np.int64)
        rows = gather_rows((np.cumsum(counts) - counts)[places], counts[places])
        # `take` copies elements as they are, an index copies them field by field
        return EncodedVoxels(self.voxels.take(places), self.gaussians.take(rows), self.size_m)

    def slice(self, start: int, stop: int) -> EncodedVoxels:
        """Return the voxels with the indices start to stop - 1, or fewer at the end."""
        ends = np.cumsum(self.voxels["counts"][:stop], dtype=np.int64)
        first, last = int(ends[start - 1]) if start else 0, int(ends[-1]) if len(ends) else 0
        return EncodedVoxels(self.voxels[start:stop], self.gaussians[first:last], self.size_m)

    def with_computed_sums(self) -> EncodedVoxels:
        """Return the voxels with the Σkappa of their own Gaussians (Sec. III-E)."""
        totals = np.concatenate([np.zeros(1, np.uint64), np.cumsum(self.gaussians["kappa"], dtype=np.uint64)])
        ends = np.cumsum(self.voxels["counts"], dtype=np.int64)
        voxels = self.voxels.copy()
        voxels["kappa_sums"] = np.diff(totals[ends], prepend=np.uint64(0))
        return EncodedVoxels(voxels, self.gaussians, self.size_m)

    def content(self) -> list[bytes]:
        """Return the Gaussians of each voxel as they are stored."""
        data, size = self.gaussians.tobytes(), self.gaussians.itemsize
        ends = (np.cumsum(self.voxels["counts"], dtype=np.int64) * size).tolist()
        return [data[start:end] for start, end in zip([0, *ends], ends, strict=False)]

    def batch(self) -> VoxelBatch:
        """Return the voxels with their Gaussians as floats. Raises CodecError, InvalidInputError for other bytes."""
        keys, counts = self.keys, self.counts
        if self.size_m:
            gaussians = decode_codes(keys, counts, self.gaussians, VoxelGrid(self.size_m))
        else:
            gaussians = from_records(self.gaussians.tobytes())
        return VoxelBatch(keys, np.ascontiguousarray(self.voxels["kappa_sums"]), counts, gaussians)

    def by_tile(self) -> list[EncodedVoxels]:
        """Return the voxels of each tile; the tiles and the keys in them ascend, as the keys of these voxels do."""
        tiles = tiles_of(self.keys)
        if len(tiles) == 0 or (tiles == tiles[0]).all():
            return [self] if len(tiles) else []
        order = np.argsort(tiles, kind="stable")
        tiles, ordered = tiles[order], self.take(order)
        ends = [*(np.flatnonzero(np.diff(tiles)) + 1).tolist(), len(tiles)]
        last = np.cumsum(ordered.voxels["counts"], dtype=np.int64)[np.array(ends) - 1].tolist()
        return [
            EncodedVoxels(ordered.voxels[start:end], ordered.gaussians[first:stop], self.size_m)
            for start, end, first, stop in zip([0, *ends], ends, [0, *last], last, strict=False)
        ]

    def to_row(self) -> bytes:
        """Return the row of these voxels."""
        return _HEAD.pack(self.size_m, len(self)) + self.voxels.tobytes() + self.gaussians.tobytes()

    @classmethod
    def from_row(cls, row: bytes) -> EncodedVoxels:
        """Return the voxels of a row. Raises StorageError for bytes that are none."""
        size_m, voxels = _HEAD.unpack_from(row) if len(row) >= _HEAD.size else (0.0, -1)
        dtype = CODES if size_m else RECORD
        start = _HEAD.size + voxels * VOXELS.itemsize
        if voxels < 0 or start > len(row) or (len(row) - start) % dtype.itemsize:
            raise StorageError(f"stored row: expected voxels and Gaussians, got {len(row)} bytes; the store is damaged")
        table, gaussians = np.frombuffer(row, VOXELS, voxels, _HEAD.size), np.frombuffer(row, dtype, offset=start)
        if int(table["counts"].sum(dtype=np.int64)) != len(gaussians):
            raise StorageError(f"stored row: expected another number of Gaussians than {len(gaussians)}; it is damaged")
        return cls(table, gaussians, size_m)


def join_elements(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the elements of all parts, which have one type, as they are."""
    dtype = parts[0].dtype
    return np.concatenate([part.view(f"V{dtype.itemsize}") for part in parts]).view(dtype)


def voxel_table(
    keys: Int64[ndarray, " v"],
    update_seqs: int | Int64[ndarray, " v"],
    kappa_sums: UInt64[ndarray, " v"],
    counts: UInt32[ndarray, " v"],
) -> NDArray[Any]:
    """Return an element of VOXELS for each voxel."""
    table = np.empty(len(keys), VOXELS)
    for name, column in zip(VOXELS.names or (), (keys, update_seqs, kappa_sums, counts), strict=True):
        table[name] = column
    return table


@dataclass(frozen=True, slots=True, eq=False)
class EncodedSubset:
    """One message of an agent, see RoiSubset, as a store keeps it."""

    agent_id: str
    message_seq: int  # see RoiSubset
    update_seq: int
    voxels: EncodedVoxels

    @classmethod
    def exact(cls, subset: RoiSubset) -> EncodedSubset:
        """Return a message that keeps every bit of its Gaussians."""
        voxels = EncodedVoxels.exact(subset.batch, subset.update_seq)
        return cls(subset.agent_id, subset.message_seq, subset.update_seq, voxels)


def decode_codes(
    keys: Int64[ndarray, " v"], counts: UInt32[ndarray, " v"], codes: NDArray[Any], grid: VoxelGrid
) -> Gaussians:
    """Return the Gaussians of these codes. Raises CodecError for codes out of range."""
    voxel = np.repeat(grid.indices(keys), counts, axis=0)
    scales, packed, label = codes["scales"], codes["largest_and_opacity"], codes["active_and_target"]
    return Gaussians(
        means_m=columns.points_of(codes["fractions"], voxel, grid),
        quats_wxyz=columns.decode_quats(packed >> OPACITY_BITS, codes["quats"], columns.quat_steps(scales)),
        scales_m=columns.decode_scales(scales),
        opacities=columns.decode_opacities(packed & (1 << OPACITY_BITS) - 1),
        rgb=columns.decode_rgb(codes["rgb"]),
        active=(label >> TARGET_BITS).astype(np.bool_),
        kappa=codes["kappa"].astype(np.uint32),
        target=(label & (1 << TARGET_BITS) - 1).astype(np.int16) - np.int16(1),
    )


def to_records(gaussians: Gaussians) -> NDArray[Any]:
    """Return one packed row per Gaussian, in order."""
    records = np.empty(len(gaussians), RECORD)
    for name in RECORD.names or ():
        records[name] = getattr(gaussians, name)
    return records


def from_records(data: bytes) -> Gaussians:
    """Decode packed rows. Raises StorageError if the length is not a multiple of a row."""
    if len(data) % RECORD.itemsize:
        raise StorageError(
            f"stored voxel: expected a multiple of {RECORD.itemsize} bytes, got {len(data)}; the store is damaged"
        )
    records = np.frombuffer(data, RECORD)
    return Gaussians(*(np.ascontiguousarray(records[field.name]) for field in fields(Gaussians)))
