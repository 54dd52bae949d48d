"""Stream a map to a watcher: a snapshot, then its changes, in blocks that are encoded when due, within one budget."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from threading import Lock
from typing import Protocol, runtime_checkable

from gausslite.codec.subset_codec import encode_subset, split_batch
from gausslite.domain.errors import RevisionGoneError
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid
from gausslite.v1.gaussians_pb2 import MapBlock, Provenance
from gausslite.wire.views import ChangeNotifier

READ_DEADLINE_S = 60.0
"""For one message of at most a megabyte: 17 kB/s."""
BLOCK_BYTES = 1 << 19
_BUDGET_BYTES = 64 << 20
_STEP_AGE_S = 1.0
_STRIPES = 16
EncodedPart = tuple[bytes, Provenance | None]
"""Voxels in the subset codec, and the agents that win them, None if the map has one agent."""
Parts = Iterable[tuple[EncodedPart, ...]]


@runtime_checkable
class MapReader(Protocol):
    """What a watcher follows of a map. The methods and what they return are used in any thread, one at a time."""

    def snapshot(self) -> tuple[int, Parts]:
        """Return a revision and the whole map, encoded when it is read: newer than the revision, never older."""

    def changes(self, since_revision: int) -> tuple[int, Parts]:
        """Return a revision and what changed up to it. Raises RevisionGoneError."""


def map_blocks(reader: MapReader, since_revision: int) -> Iterator[MapBlock]:
    """Yield the blocks that lead from a revision (0: nothing) to the current one, at least one; the last is marked.

    What changes during a snapshot follows before the last block. So the watcher then has the map at the revision of the
    last block. Raises RevisionGoneError, InvalidInputError if the codec cannot encode the map.
    """
    end, waiting = since_revision, None
    for end, parts in _reads(reader, since_revision):
        for data, provenance in chain.from_iterable(parts):
            if waiting is not None:
                yield waiting
            waiting = MapBlock(revision=end, snapshot=since_revision == 0, subset=data, provenance=provenance)
    waiting = waiting or MapBlock(snapshot=since_revision == 0)
    waiting.revision, waiting.last = end, True
    yield waiting


def _reads(reader: MapReader, since_revision: int) -> Iterator[tuple[int, Parts]]:
    revision = since_revision
    if since_revision == 0:
        revision, parts = reader.snapshot()
        yield revision, parts
    try:
        changes = reader.changes(revision)
    except RevisionGoneError:
        if since_revision > 0:
            raise
        # more was removed during the snapshot than is recorded; from its revision the watcher gets a new one
        return
    yield changes


async def follow(
    read: Callable[[int], Awaitable[MapReader]],
    revision: Callable[[], int],
    since_revision: int,
    changes: ChangeNotifier,
    work: Callable[[Callable[[Iterator[MapBlock]], MapBlock | None], Iterator[MapBlock]], Awaitable[MapBlock | None]],
) -> AsyncIterator[MapBlock]:
    """Yield a map's changes since a revision (0: the map first), without end. A slow watcher gets several as one.

    read: returns the reader of the changes since a revision, which `work` uses in a thread. revision: returns the map's
    current one, or raises what ends the stream. A watcher that missed more than is recorded gets a new snapshot;
    since_revision itself raises RevisionGoneError.
    """
    blocks = map_blocks(await read(since_revision), since_revision)
    block = await work(_next_block, blocks)
    while True:
        while block is not None:
            since_revision = block.revision
            with read_deadline():
                yield block
            block = await work(_next_block, blocks)
        changed = changes.subscribe()
        while revision() == since_revision:
            await changed.wait()
            changed = changes.subscribe()
        try:
            blocks = map_blocks(await read(since_revision), since_revision)
            block = await work(_next_block, blocks)
        except RevisionGoneError:
            blocks = map_blocks(await read(0), 0)
            block = await work(_next_block, blocks)


@contextmanager
def read_deadline(limit_s: float = READ_DEADLINE_S) -> Iterator[None]:
    """Cancel the current task, the call, if the block takes longer: its client has stopped reading.

    Use it around the `yield` of one message, so that no stream holds memory for ever.
    """
    task = asyncio.current_task()
    assert task is not None
    timer = asyncio.get_running_loop().call_later(limit_s, task.cancel, "the client has stopped reading")
    try:
        yield
    finally:
        timer.cancel()


def encode_parts(
    batch: VoxelBatch, grid: VoxelGrid, sender: str, provenance: Callable[[VoxelBatch], Provenance] | None = None
) -> tuple[EncodedPart, ...]:
    """Encode voxels in parts far below the client's size limit; no part if there are none.

    sender: the agent id inside the encoded bytes. provenance: returns the agent of each voxel of a part.
    """
    return tuple(
        (encode_subset(RoiSubset(sender, "", 0, 0, part), grid), None if provenance is None else provenance(part))
        for part in split_batch(batch, BLOCK_BYTES)
    )


class EncodedPartCache:
    """Keeps the parts used last, up to a number of bytes for all watchers together. Thread-safe."""

    def __init__(self, budget_bytes: int = _BUDGET_BYTES) -> None:
        self._budget_bytes = budget_bytes
        self._lock = Lock()
        # held while parts are encoded, so that several threads do not encode the same ones
        self._encoding = [Lock() for _ in range(_STRIPES)]
        self._steps: OrderedDict[Hashable, tuple[float, int]] = OrderedDict()
        self._parts: OrderedDict[Hashable, tuple[EncodedPart, ...]] = OrderedDict()
        self._held_bytes = 0

    def get(self, key: Hashable, encode: Callable[[], tuple[EncodedPart, ...]]) -> tuple[EncodedPart, ...]:
        """Return the parts of this key; encode them if they are not kept."""
        with self._encoding[hash(key) % _STRIPES]:
            with self._lock:
                if key in self._parts:
                    self._parts.move_to_end(key)
                    return self._parts[key]
            parts = encode()
            with self._lock:
                self._parts[key] = parts
                self._held_bytes += _size_bytes(parts)
                while self._held_bytes > self._budget_bytes:
                    self._held_bytes -= _size_bytes(self._parts.popitem(last=False)[1])
            return parts

    def step(self, start: Hashable, newest_revision: int) -> int:
        """Return the revision to which the watchers go from here: the newest one, or that of a moment ago.

        So watchers that follow closely stay together and share the parts, however fast the map changes.
        """
        now_s = time.monotonic()
        with self._lock:
            while self._steps and next(iter(self._steps.values()))[0] < now_s - _STEP_AGE_S:
                self._steps.popitem(last=False)
            return self._steps.setdefault(start, (now_s, newest_revision))[1]


def _next_block(blocks: Iterator[MapBlock]) -> MapBlock | None:
    return next(blocks, None)


def _size_bytes(parts: tuple[EncodedPart, ...]) -> int:
    # a message of integers takes about 4 bytes for each in memory
    return sum(
        len(data) + (0 if provenance is None else 4 * len(provenance.winner)) + 256 for data, provenance in parts
    )
