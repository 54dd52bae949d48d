"""Encode parts of the fused map once for all watchers, within one memory budget."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock

import numpy as np

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxel_operations import merge_batches, tombstones
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.fused_map import WonVoxels
from gausslite.v1.gaussians_pb2 import Provenance

BLOCK_BYTES = 1 << 19
_SENDER = "fusion-server"
"""The agent id inside the subset bytes of fused voxels; readers use the provenance instead."""
_BUDGET_BYTES = 64 << 20
EncodedPart = tuple[bytes, Provenance]
"""The voxels of a part in the subset codec, and the agents that win them."""


def encode_parts(won: WonVoxels, removed: np.ndarray, grid: VoxelGrid) -> tuple[EncodedPart, ...]:
    """Encode voxels and, as tombstones, the keys of empty ones; no part if there are none."""
    agents = sorted(won.keys_by_winner)
    winner_of = {key: index for index, name in enumerate(agents) for key in won.keys_by_winner[name]}
    parts = split_batch(merge_batches(won.batch, tombstones(removed)), BLOCK_BYTES)
    return tuple((_encode(part, grid), _provenance(part, agents, winner_of)) for part in parts)


class EncodedPartCache:
    """Keeps the parts used last, up to a number of bytes for all watchers together. Thread-safe."""

    def __init__(self, budget_bytes: int = _BUDGET_BYTES) -> None:
        self._budget_bytes = budget_bytes
        self._lock = Lock()
        self._parts: OrderedDict[Hashable, tuple[EncodedPart, ...]] = OrderedDict()
        self._held_bytes = 0

    @property
    def held_bytes(self) -> int:
        """The bytes of all parts kept."""
        return self._held_bytes

    def get(self, key: Hashable, encode: Callable[[], tuple[EncodedPart, ...]]) -> tuple[EncodedPart, ...]:
        """Return the parts of this key; encode them if they are not kept."""
        with self._lock:
            if key in self._parts:
                self._parts.move_to_end(key)
                return self._parts[key]
        parts = encode()
        with self._lock:
            if key not in self._parts:
                self._parts[key] = parts
                self._held_bytes += _size_bytes(parts)
            while self._held_bytes > self._budget_bytes:
                self._held_bytes -= _size_bytes(self._parts.popitem(last=False)[1])
        return parts


def _encode(part: VoxelBatch, grid: VoxelGrid) -> bytes:
    return encode_subset(RoiSubset(_SENDER, "", 0, 0, part), grid)


def _provenance(part: VoxelBatch, agents: list[str], winner_of: dict[int, int]) -> Provenance:
    if not agents:
        return Provenance()
    return Provenance(agent_ids=agents, winner=[winner_of.get(key, 0) for key in part.keys.tolist()])


def _size_bytes(parts: tuple[EncodedPart, ...]) -> int:
    # a message of integers takes about 4 bytes for each in memory
    return sum(len(data) + 4 * len(provenance.winner) + 256 for data, provenance in parts)
