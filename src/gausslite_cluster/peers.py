"""Call the other servers of a mission, and send them the parts of messages whose voxels they own, in a fair order."""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

import grpc

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import UnavailableError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.limits import SessionRecord
from gausslite.fusion.traffic import Acknowledgements
from gausslite.fusion.updates import PendingUpdate, UpdateQueue
from gausslite.v1 import region_service_pb2 as region_pb
from gausslite.v1 import region_service_pb2_grpc as region_pb_grpc
from gausslite.wire.channel import KEEPALIVE_S, channel_options, connection_options
from gausslite.wire.security import Tls
from gausslite.wire.status import from_rpc_error
from gausslite_cluster.region_host import WAIT_S, RegionHost
from gausslite_cluster.region_servicer import SLOTS_KEY, RegionServicer
from gausslite_cluster.regions import ALL_SLOTS
from gausslite_fusion_server.contributions import StoredCount

CALL_S = 30.0
READ_S = 600.0
"""Of a part of the map."""


@contextmanager
def peer_errors(server: str) -> Iterator[None]:
    """Raise the errors of calls to another server as GaussLite errors."""
    try:
        yield
    except grpc.aio.AioRpcError as error:
        raise from_rpc_error(error, f"server {server}") from error


async def stated_slots(call: Any) -> frozenset[int]:
    """Return the slots for which the answer of a call holds."""
    metadata = dict(await call.initial_metadata() or ())
    bits = int(metadata.get(SLOTS_KEY, "0"), 16)
    return frozenset(slot for slot in ALL_SLOTS if bits >> slot & 1)


def require_all(parts: Iterable[frozenset[int]], wanted: frozenset[int] = ALL_SLOTS) -> None:
    """Raise UnavailableError unless these answers hold for each wanted slot, and no two of them for the same one."""
    slots = list(itertools.chain.from_iterable(parts))
    if len(set(slots)) < len(slots) or not wanted <= set(slots):
        raise UnavailableError("fusion server: regions move from one server to another; try again in a moment")


def _open_channel(address: str, tls: Tls | None) -> grpc.aio.Channel:
    """Open a channel for the event loop with the limits of both ends."""
    own = *connection_options(KEEPALIVE_S), ("grpc.max_reconnect_backoff_ms", 500)
    options = channel_options(address, tls, own)
    if tls is None:
        return grpc.aio.insecure_channel(address, options=options)
    return grpc.aio.secure_channel(address, tls.client_credentials(), options=options)


class Peers:
    """Owns the connections to the servers, also the one to this server itself. Use it on the event loop."""

    def __init__(self, tls: Tls | None) -> None:
        self._tls = tls
        self._connected: dict[str, tuple[grpc.aio.Channel, Any]] = {}

    def stub(self, server: str) -> Any:
        """Return the methods of a server."""
        if server not in self._connected:
            channel = _open_channel(server, self._tls)
            self._connected[server] = channel, region_pb_grpc.RegionServiceStub(channel)
        return self._connected[server][1]

    async def call(self, server: str, method: str, request: Any) -> Any:
        """Return the answer of one server. Raises GaussLiteError."""
        with peer_errors(server):
            return await getattr(self.stub(server), method)(request, timeout=CALL_S)

    async def call_all(
        self, servers: Iterable[str], method: str, request: Any, timeout_s: float = CALL_S
    ) -> dict[str, Any]:
        """Return the answer of each server to a unary call, or all its answers to a streaming call.

        Raises UnavailableError unless the answers hold for all slots together, and the errors of the servers.
        """

        async def answer_of(server: str) -> tuple[frozenset[int], Any]:
            with peer_errors(server):
                call = getattr(self.stub(server), method)(request, timeout=timeout_s)
                if isinstance(call, grpc.aio.UnaryUnaryCall):
                    answer = await call
                else:
                    answer = [response async for response in call]
                return await stated_slots(call), answer

        names = list(servers)
        results = await asyncio.gather(*map(answer_of, names))
        require_all(slots for slots, _ in results)
        return {name: answer for name, (_, answer) in zip(names, results, strict=True)}

    async def send_part(self, server: str, session_id: str, part: EncodedSubset) -> StoredCount:
        """Send a part of a message to its owner; returns when it is durable. Raises what the owner raised."""
        request = region_pb.StorePartRequest(
            session_id=session_id,
            agent_id=part.agent_id,
            message_seq=part.message_seq,
            update_seq=part.update_seq,
            voxels=part.voxels.to_row(),
        )
        with peer_errors(server):
            # a part of a message that is sent again meanwhile is stored once
            stored = await self.stub(server).StorePart(request, timeout=CALL_S)
        return StoredCount(stored.accepted_voxels, stored.stale_voxels)

    async def close(self) -> None:
        """Close the connections; open calls end."""
        for channel, _ in self._connected.values():
            await channel.close(None)


_OWNER_BYTES = 16 << 20
"""Of all agents, on their way to one owner."""
_RETRY_S = 0.05


class PartSender:
    """Owns the queue of received messages. Use it on the event loop; one thread decodes.

    A message is decoded to the codes of its Gaussians, once, by the server that received it. If some parts are stored
    and another one is refused, the stored ones stay, as with the slices of store_slices.
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

    async def _decode(self, session: SessionRecord, message: bytes) -> EncodedSubset:
        update = PendingUpdate(session.session_id, session.agent_id, message)
        self._queue.add(update)
        # one turn for each message, for the one that is next then
        self._decoder.submit(self._decode_next)
        subset: EncodedSubset = await asyncio.wrap_future(update.future)
        return subset

    def _decode_next(self) -> None:
        [update] = self._queue.take(1)
        update.decode(self._grid)
        if not update.future.done():
            update.future.set_result(update.subset)
        self._queue.put_back(update)

    @contextmanager
    def _room_for(self, subset: EncodedSubset) -> Iterator[None]:
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

    async def _store(self, session_id: str, subset: EncodedSubset) -> StoredCount:
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

    async def _store_part(self, owner: str | None, session_id: str, part: EncodedSubset) -> StoredCount:
        if owner is None:
            raise UnavailableError("fusion server: nobody owns some of these voxels; try again in a moment")
        if owner == self._host.server:
            return await self._regions.store_part(session_id, part)
        self.sent += 1
        return await self._peers.send_part(owner, session_id, part)
