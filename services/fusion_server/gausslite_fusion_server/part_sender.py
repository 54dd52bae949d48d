"""Decode the messages that this server accepts, in a fair order, and send the parts to the owners of their voxels."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.errors import UnavailableError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.store_values import SessionRecord
from gausslite.fusion.traffic import Acknowledgements
from gausslite.fusion.updates import PendingUpdate, UpdateQueue, decode_own
from gausslite_fusion_server.contributions import StoredCount
from gausslite_fusion_server.peers import Peers
from gausslite_fusion_server.region_host import WAIT_S, RegionHost
from gausslite_fusion_server.region_servicer import RegionServicer

_OWNER_BYTES = 16 << 20
"""Of all agents, on their way to one owner."""
_RETRY_S = 0.05


class PartSender:
    """Owns the queue of received messages. Use it on the event loop; one thread decodes.

    A message is decoded to the codes of its Gaussians, once, by the server that received it. If some parts are stored
    and another one is refused, the stored ones stay, as with the slices of UpdateCommitter.
    """

    def __init__(self, host: RegionHost, regions: RegionServicer, peers: Peers, grid: VoxelGrid) -> None:
        self._host, self._regions, self._peers, self._grid = host, regions, peers, grid
        self._queue = UpdateQueue()
        self._decoder = ThreadPoolExecutor(1, "decode")
        self._highest: dict[str, tuple[str, int]] = {}
        self._waiting_bytes: Counter[str | None] = Counter()
        self.received = self.sent = 0
        """Messages accepted from agents, and parts sent to other servers."""
        self.acknowledgements = Acknowledgements()

    async def store(self, session: SessionRecord, message: bytes) -> StoredCount:
        """Return when every owner has its part of the message. Raises GaussLiteError to refuse it."""
        answered: Future[Any] = Future()
        self.acknowledgements.add(session.agent_id, answered)
        try:
            subset = await self._decode(session, message)
            with self._room_for(subset):
                self.received += 1
                stored = await self._store(session.session_id, subset)
        finally:
            answered.set_result(None)
        highest = self.highest_acknowledged(session)
        if highest is not None:
            self.note_acknowledged(session, max(highest, subset.update_seq))
        return stored

    def highest_acknowledged(self, session: SessionRecord) -> int | None:
        """Return the highest update_seq that is known to be stored in a session; None if it was never asked for."""
        session_id, highest = self._highest.get(session.agent_id, ("", 0))
        return highest if session_id == session.session_id else None

    def note_acknowledged(self, session: SessionRecord, update_seq: int) -> None:
        """Record the highest update_seq of a session."""
        self._highest[session.agent_id] = session.session_id, update_seq

    def close(self) -> None:
        """Wait until the thread has ended."""
        self._decoder.shutdown(wait=True)

    async def _decode(self, session: SessionRecord, message: bytes) -> StoredSubset:
        update = PendingUpdate(session.session_id, session.agent_id, message)
        self._queue.add(update)
        # one turn for each message, for the one that is next then
        self._decoder.submit(self._decode_next)
        subset: StoredSubset = await asyncio.wrap_future(update.future)
        return subset

    def _decode_next(self) -> None:
        [update] = self._queue.take(1)
        try:
            assert isinstance(update.message, bytes)
            update.future.set_result(decode_own(update.message, update.agent_id, self._grid))
        except Exception as error:
            # reaches the call; this thread decodes the messages of all agents
            update.future.set_exception(error)
        finally:
            self._queue.put_back(update, is_done=True)

    @contextmanager
    def _room_for(self, subset: StoredSubset) -> Iterator[None]:
        """Count what waits for its owners. Raises UnavailableError if one of them has too much to store already."""
        parts = self._host.owners.split(subset)
        sizes = {owner: part.voxels.voxels.nbytes + part.voxels.gaussians.nbytes for owner, part in parts}
        for owner, size in sizes.items():
            waiting = self._waiting_bytes[owner]
            if waiting and waiting + size > _OWNER_BYTES:
                name = owner or "a server that takes over"
                raise UnavailableError(f"fusion server: {waiting >> 20} MiB wait for {name}; try again in a moment")
        self._waiting_bytes.update(sizes)
        try:
            yield
        finally:
            self._waiting_bytes.subtract(sizes)

    async def _store(self, session_id: str, subset: StoredSubset) -> StoredCount:
        """Send the parts; those whose owner changes are cut and sent again, for 10 s at most."""
        loop = asyncio.get_running_loop()
        end_s, waiting, accepted, stale = loop.time() + WAIT_S, [subset], 0, 0
        largest, largest_owner = 0, ""
        while True:
            changed, owners = self._host.changes.subscribe(), self._host.owners
            parts = [item for part in waiting for item in owners.split(part)]
            calls = (self._store_part(owner, session_id, part) for owner, part in parts)
            results = await asyncio.gather(*calls, return_exceptions=True)
            unavailable = None
            waiting = []
            for (owner, part), result in zip(parts, results, strict=True):
                if isinstance(result, UnavailableError):
                    unavailable = result
                    waiting.append(part)
                elif isinstance(result, BaseException):
                    raise result
                else:
                    accepted, stale = accepted + result.accepted, stale + result.stale
                    largest, largest_owner = max((largest, largest_owner), (len(part.voxels), owner or ""))
            if unavailable is None:
                return StoredCount(accepted, stale, "" if largest_owner == self._host.server else largest_owner)
            self._host.wake()
            if loop.time() > end_s:
                raise unavailable
            with suppress(TimeoutError):
                await asyncio.wait_for(changed.wait(), _RETRY_S if owners is self._host.owners else 0.0)

    async def _store_part(self, owner: str | None, session_id: str, part: StoredSubset) -> StoredCount:
        if owner is None:
            raise UnavailableError("fusion server: nobody owns some of these voxels; try again in a moment")
        if owner == self._host.server:
            return await self._regions.store_part(session_id, part)
        self.sent += 1
        return await self._peers.send_part(owner, session_id, part)
