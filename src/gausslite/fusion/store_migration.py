"""Convert rows of a voxel each, which earlier releases stored, to rows of an UpdateLog.

An old row of Gaussians was exact records, or the voxel's size (float64) and codes with a kappa of two bytes.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from gausslite.codec.stored import RECORD
from gausslite.codec.stored_voxels import CODES, StoredVoxels, voxel_table
from gausslite.domain.errors import StorageError
from gausslite.domain.voxels import tile_of
from gausslite.fusion.store_rows import SEGMENT_BITS, SLOT_BITS, SlotsOf, UpdateRow, row_checksum

OldRow = tuple[str, int, int, int, int, int, bytes]
"""agent_id, voxel, update_seq, Σkappa, count, checksum, Gaussians."""
_OLD_CODES = np.dtype([*CODES.descr[:-1], ("kappa", "<u2")])
_SIZE, _HEADER = struct.Struct("<d"), struct.Struct("<qqqq")
_SEGMENT_ROWS = 64


def rows_of_voxels(
    old: Iterable[OldRow], damaged: Callable[[str], StorageError], slots_of: SlotsOf = np.zeros_like
) -> Iterator[UpdateRow]:
    """Yield the new rows; the old ones are sorted by agent and voxel. Raises what `damaged` makes of a damaged one."""
    groups = itertools.groupby(old, key=lambda row: (row[0], tile_of(row[1]), _size_m(row)))
    for count, ((agent_id, _, size_m), rows) in enumerate(groups):
        number = (count // _SEGMENT_ROWS + 1 << SEGMENT_BITS) + count % _SEGMENT_ROWS
        own = list(rows)
        for row in own:
            _require_intact(row, damaged)
        _, keys, seqs, sums, counts, _, data = zip(*own, strict=True)
        number += int(slots_of(np.array(keys[:1], np.int64))[0]) << SLOT_BITS
        table = voxel_table(np.array(keys), np.array(seqs), np.array(sums, np.uint64), np.array(counts, np.uint32))
        voxels = StoredVoxels(table, _gaussians(data, size_m), size_m).to_row()
        yield number, agent_id, row_checksum(number, agent_id, voxels), voxels


def _gaussians(rows: Iterable[bytes], size_m: float) -> NDArray[Any]:
    if not size_m:
        return np.frombuffer(b"".join(rows), RECORD)
    old = np.frombuffer(b"".join(row[_SIZE.size :] for row in rows), _OLD_CODES)
    codes = np.empty(len(old), CODES)
    for name in CODES.names or ():
        codes[name] = old[name]
    return codes


def _size_m(row: OldRow) -> float:
    """Return the voxel size of a row of codes; 0 for exact records."""
    count, data = row[4], row[6]
    return 0.0 if len(data) == count * RECORD.itemsize else float(_SIZE.unpack_from(data.ljust(_SIZE.size))[0])


def _require_intact(row: OldRow, damaged: Callable[[str], StorageError]) -> None:
    agent_id, voxel, update_seq, kappa_sum, count, checksum, data = row
    head = agent_id.encode() + _HEADER.pack(voxel, update_seq, kappa_sum, count)
    sizes = count * RECORD.itemsize, _SIZE.size + count * _OLD_CODES.itemsize
    if len(data) not in sizes or google_crc32c.extend(google_crc32c.value(head), data) != checksum:
        raise damaged(f"voxel {voxel} of agent {agent_id!r}")
