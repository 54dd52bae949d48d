"""Streams of voxel updates of many agents over one connection, in one asyncio loop; load generators use them."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Sequence

import grpc

from gausslite.domain.errors import CodecError
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.address import require_callable


def is_stored(outcome: pb.SubsetOutcome) -> bool:
    """Return whether the server has the updates of a message, or newer ones of the same voxels."""
    return outcome.status in (pb.SUBSET_STATUS_ACCEPTED, pb.SUBSET_STATUS_STALE)


class UpdateStream:
    """One agent's stream. The methods raise grpc.aio.AioRpcError if the server ends it."""

    def __init__(self, stub: pb_grpc.FusionServiceAsyncStub, session_id: str) -> None:
        self._stub, self._session_id = stub, session_id
        # without an iterator, the caller writes
        self._call = stub.ContributeSubsets()  # type: ignore[call-arg]
        self._sequence = 0

    async def send(self, subset: bytes) -> None:
        """Send an encoded subset and wait for its acknowledgement. Raises CodecError if it is not accepted."""
        self._sequence += 1
        await self._call.write(self._request(subset, self._sequence))
        response = await self._call.read()
        if not isinstance(response, pb.ContributeSubsetsResponse):
            raise CodecError(f"subset {self._sequence}: expected an acknowledgement, got the end of the stream")
        if response.outcomes[0].status != pb.SUBSET_STATUS_ACCEPTED:
            raise CodecError(f"subset {self._sequence}: {response.outcomes[0].message or 'not accepted'}")

    async def resend(self, subsets: Sequence[bytes]) -> int:
        """Send messages of the past again, in this order; returns how many got an outcome before the stream ended."""
        count = 0
        with contextlib.suppress(grpc.RpcError):
            for subset in subsets:
                self._sequence += 1
                await self._call.write(self._request(subset, self._sequence))
                if not isinstance(await self._call.read(), pb.ContributeSubsetsResponse):
                    break
                count += 1
            await self.close()
        return count

    async def close(self) -> None:
        """End the stream."""
        await self._call.done_writing()

    async def resend_forever(self, subset: bytes) -> None:
        """Send the same subset as fast as flow control lets it pass, without waiting for acknowledgements."""

        async def requests() -> AsyncIterator[pb.ContributeSubsetsRequest]:
            while True:
                self._sequence += 1
                yield self._request(subset, self._sequence)

        async for _ in self._stub.ContributeSubsets(requests()):
            pass

    def _request(self, subset: bytes, sequence: int) -> pb.ContributeSubsetsRequest:
        return pb.ContributeSubsetsRequest(session_id=self._session_id, sequence=sequence, subset=subset)


class UpdateStreams:
    """Owns the connection; an asynchronous context manager. Raises InvalidInputError for a malformed address."""

    def __init__(self, address: str) -> None:
        require_callable("UpdateStreams address", address)
        self._channel = grpc.aio.insecure_channel(address)
        self._stub = pb_grpc.FusionServiceStub(self._channel)

    async def __aenter__(self) -> UpdateStreams:
        return self

    async def __aexit__(self, *exception: object) -> None:
        await self._channel.close(None)

    def open(self, session_id: str) -> UpdateStream:
        """Return a new stream of a session."""
        return UpdateStream(self._stub, session_id)
