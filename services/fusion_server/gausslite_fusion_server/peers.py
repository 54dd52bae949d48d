"""Call the other servers of a mission: one of them, or all owners at once."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import grpc

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.errors import UnavailableError
from gausslite.fusion.regions import ALL_SLOTS
from gausslite.v1 import region_service_pb2 as region_pb
from gausslite.v1 import region_service_pb2_grpc as region_pb_grpc
from gausslite.wire.channel import open_async_channel
from gausslite.wire.security import Tls
from gausslite.wire.status import from_rpc_error
from gausslite_fusion_server.contributions import StoredCount
from gausslite_fusion_server.region_servicer import SLOTS_KEY

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


class Peers:
    """Owns the connections to the servers, also the one to this server itself. Use it on the event loop."""

    def __init__(self, tls: Tls | None) -> None:
        self._tls = tls
        self._connected: dict[str, tuple[grpc.aio.Channel, Any]] = {}

    def stub(self, server: str) -> Any:
        """Return the methods of a server."""
        if server not in self._connected:
            channel = open_async_channel(server, self._tls)
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

    async def send_part(self, server: str, session_id: str, part: StoredSubset) -> StoredCount:
        """Send a part of a message to its owner; returns when it is durable. Raises what the owner raised."""
        request = region_pb.StorePartRequest(
            session_id=session_id,
            agent_id=part.agent_id,
            message_seq=part.message_seq,
            update_seq=part.update_seq,
            voxels=part.voxels.to_row(),
        )
        with peer_errors(server):
            # the end of the connection ends the wait
            stored = await self.stub(server).StorePart(request)
        return StoredCount(stored.accepted_voxels, stored.stale_voxels)

    async def close(self) -> None:
        """Close the connections; open calls end."""
        for channel, _ in self._connected.values():
            await channel.close(None)
