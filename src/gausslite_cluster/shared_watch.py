"""Follow a map whose parts several servers own: one stream to each owner of what is looked at, merged for a watcher."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import OrderedDict
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any

import numpy as np

from gausslite.domain.errors import RevisionGoneError, UnavailableError
from gausslite.domain.voxels import TILE_VOXELS, AxisAlignedBox, VoxelGrid
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite.wire.map_changes import read_deadline
from gausslite_cluster.peers import Peers, peer_errors, require_all, stated_slots
from gausslite_cluster.region_host import WAIT_S, RegionHost
from gausslite_cluster.regions import ALL_SLOTS, Owners, slots_of

_MAX_REVISIONS = 10_000
_MAX_TILES = 4096
"""A larger region is taken for the whole map."""
_RETRY_S = 0.1
_Blocks = asyncio.Queue[tuple[str, MapBlock] | Exception]
Positions = Mapping[str, int]
"""The revision of each server's part."""


class SharedRevisions:
    """Gives each state that watchers have seen a number, which only this server understands: a vector of revisions.

    The numbers begin at the process's start in microseconds, so that those from before a restart are gone.
    """

    def __init__(self) -> None:
        self._numbers = itertools.count(time.time_ns() // 1000)
        self._positions: OrderedDict[int, Positions] = OrderedDict()

    def next(self) -> int:
        """Return the number of a state that begins to be sent."""
        return next(self._numbers)

    def record(self, number: int, positions: Positions) -> None:
        """Note the state of a number, which has been sent."""
        self._positions[number] = dict(positions)
        if len(self._positions) > _MAX_REVISIONS:
            self._positions.popitem(last=False)

    def positions(self, number: int) -> Positions:
        """Return the state of a number. Raises RevisionGoneError if it is another server's, or too old."""
        if number not in self._positions:
            raise RevisionGoneError("since_revision: expected a recent one of this server, or 0 for a snapshot")
        return self._positions[number]


@dataclass(frozen=True, slots=True)
class SharedWatch:
    """Follows the map for watchers. After a move of regions that are looked at, a watcher gets a new snapshot."""

    host: RegionHost
    peers: Peers
    revisions: SharedRevisions
    grid: VoxelGrid

    async def follow(
        self, request: pb.WatchFusedMapRequest, region: AxisAlignedBox | None, require_open: Callable[[], None]
    ) -> AsyncIterator[pb.WatchFusedMapResponse]:
        """Yield the map's changes since a revision (0: the map first), without end.

        Raises RevisionGoneError, UnavailableError if regions move during a snapshot, and what `require_open` raises.
        """
        positions = self.revisions.positions(request.since_revision) if request.since_revision else {}
        slots = _slots_in(region, self.grid)
        end_s, number, latest = time.monotonic() + WAIT_S, 0, MapBlock(last=True)
        while True:
            state = dict(positions)
            try:
                async with aclosing(self._follow(request, slots, state)) as blocks:
                    async for latest in blocks:
                        number = number or self.revisions.next()
                        latest.revision, end_s = number, time.monotonic() + WAIT_S
                        if latest.last:
                            self.revisions.record(number, state)
                            number = 0
                        with read_deadline():
                            yield pb.WatchFusedMapResponse(block=latest)
            except UnavailableError:
                self.host.wake()
                require_open()
                if time.monotonic() > end_s or (latest.snapshot and not latest.last):
                    raise
                if not latest.last:
                    # a snapshot begins only after a last block
                    yield pb.WatchFusedMapResponse(block=MapBlock(revision=number, last=True))
                positions, number, latest = {}, 0, MapBlock(last=True)
                await asyncio.sleep(_RETRY_S)

    async def _follow(
        self, request: pb.WatchFusedMapRequest, slots: frozenset[int], positions: dict[str, int]
    ) -> AsyncGenerator[MapBlock]:
        """Yield from the streams of the owners as they are now. Raises UnavailableError when the regions move."""
        await self.host.ready()
        owners = self.host.owners
        servers = _owners_of(slots, owners)
        if positions and positions.keys() != set(servers):
            raise RevisionGoneError("since_revision: the regions have moved since; expected 0 for a snapshot")
        calls = {server: self._open(server, request, positions.get(server, 0)) for server in servers}
        blocks: _Blocks = asyncio.Queue(1)
        tasks = [asyncio.create_task(self._end_when_moved(slots, owners, blocks))]
        try:
            with peer_errors(", ".join(servers)):
                require_all([await stated_slots(call) for call in calls.values()], slots)
                if not positions:
                    async for block in _snapshot(calls, positions):
                        yield block
            tasks += [asyncio.create_task(_pump(server, call, blocks)) for server, call in calls.items()]
            while True:
                item = await blocks.get()
                if isinstance(item, Exception):
                    raise item
                server, block = item
                if block.last:
                    positions[server] = block.revision
                yield block
        finally:
            for call in calls.values():
                call.cancel()
            for task in tasks:
                task.cancel()

    def _open(self, server: str, request: pb.WatchFusedMapRequest, since_revision: int) -> Any:
        own = pb.WatchFusedMapRequest()
        own.CopyFrom(request)
        own.since_revision = since_revision
        return self.peers.stub(server).WatchFusedMap(own)

    async def _end_when_moved(self, slots: frozenset[int], owners: Owners, blocks: _Blocks) -> None:
        """Queue an UnavailableError when one of the slots has another owner."""
        while True:
            changed = self.host.changes.subscribe()
            if any(self.host.owners.server_of.get(slot) != owners.server_of.get(slot) for slot in slots):
                await blocks.put(UnavailableError("fusion server: regions have moved"))
                return
            await changed.wait()


async def _snapshot(calls: Mapping[str, Any], positions: dict[str, int]) -> AsyncIterator[MapBlock]:
    """Yield the first states of all parts as one snapshot, and note their revisions."""
    waiting: MapBlock | None = None
    for server, call in calls.items():
        async for response in call:
            block = response.block
            is_last, block.last, block.snapshot = block.last, False, True
            if waiting is not None and (waiting.subset or waiting.provenance.agent_ids):
                yield waiting
            waiting = block
            if is_last:
                positions[server] = block.revision
                break
        else:
            raise UnavailableError(f"server {server}: has ended the stream of its part")
    assert waiting is not None
    waiting.last = True
    yield waiting


async def _pump(server: str, call: Any, blocks: _Blocks) -> None:
    try:
        with peer_errors(server):
            async for response in call:
                if response.block.snapshot:
                    # it has missed more than its server remembers
                    break
                await blocks.put((server, response.block))
        await blocks.put(UnavailableError(f"server {server}: has ended the stream of its part"))
    except Exception as error:
        await blocks.put(error)


def _owners_of(slots: frozenset[int], owners: Owners) -> list[str]:
    found = {owners.server_of.get(slot) for slot in slots}
    if None in found:
        raise UnavailableError("fusion server: nobody owns some of these voxels; try again in a moment")
    return sorted(server for server in found if server is not None)


def _slots_in(region: AxisAlignedBox | None, grid: VoxelGrid) -> frozenset[int]:
    """Return the slots of the voxels in a region; all for no region, or a large one."""
    if region is None:
        return ALL_SLOTS
    tile_m, limit_m = TILE_VOXELS * grid.size_m, 0.99 * grid.max_coordinate_m
    corners = np.clip(np.array([region.min_m, region.max_m]), -limit_m, limit_m)
    low, high = np.floor(corners / tile_m).astype(np.int64)
    if np.prod((high - low + 1).astype(np.float64)) > _MAX_TILES:
        return ALL_SLOTS
    axes = [np.arange(first, last + 1) for first, last in zip(low, high, strict=True)]
    tiles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return frozenset(slots_of(grid.keys(((tiles + 0.5) * tile_m).astype(np.float32))).tolist())
