"""Call the services from one asyncio loop, with any bytes: load generators and fuzzing do."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable, Sequence
from typing import Self

import grpc

from gausslite.domain.errors import CodecError
from gausslite.domain.objects import ObjectReport
from gausslite.v1 import agent_service_pb2, fusion_service_pb2, parser_service_pb2
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.v1.geometry_pb2 import EncodedFrame
from gausslite.wire.channel import proxy_options, require_callable
from gausslite.wire.convert_task import report_to_message

ENDED_WHILE_SENDING = "ENDED_WHILE_SENDING"
_LOCAL_ERROR = "Internal error from Core"
"""What grpc.aio makes up when the server has ended a call and a message cannot be written any more."""
_MODULES = (agent_service_pb2, fusion_service_pb2, parser_service_pb2)


def service_methods() -> dict[str, dict[str, bool]]:
    """Return the methods of each service, by its full name, and whether a method takes a stream of requests."""
    services = [service for module in _MODULES for service in module.DESCRIPTOR.services_by_name.values()]
    return {
        service.full_name: {method.name: method.client_streaming for method in service.methods} for service in services
    }


class _Connection:
    """Owns a channel; an asynchronous context manager. Raises InvalidInputError for a malformed address."""

    def __init__(self, address: str) -> None:
        require_callable("address", address)
        self._channel = grpc.aio.insecure_channel(address, options=proxy_options(address))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exception: object) -> None:
        await self._channel.close(None)


class RawCalls(_Connection):
    """The connection to one service."""

    def __init__(self, address: str, service: str) -> None:
        super().__init__(address)
        self._service = service

    async def call(self, method: str, messages: Sequence[bytes], timeout_s: float) -> str:
        """Send the messages; returns OK after the first answer or a good end, else the name of the status code.

        ENDED_WHILE_SENDING: the server has refused one of the messages, but its code has not arrived.
        """

        async def requests() -> AsyncIterator[bytes]:
            for message in messages:
                yield message

        # without serializers the bytes are sent as they are; on the wire, every kind of method is a pair of streams
        call = self._channel.stream_stream(f"/{self._service}/{method}")(  # type: ignore[call-arg]
            requests(), timeout=timeout_s
        )
        try:
            async for _ in call:
                break
        except grpc.aio.AioRpcError as error:
            return ENDED_WHILE_SENDING if error.details() == _LOCAL_ERROR else str(error.code().name)
        finally:
            call.cancel()
        return grpc.StatusCode.OK.name


def is_stored(outcome: pb.SubsetOutcome) -> bool:
    """Return whether the server has the updates of a message, or newer ones of the same voxels."""
    return outcome.status in (pb.SUBSET_STATUS_ACCEPTED, pb.SUBSET_STATUS_STALE)


def update_request(session_id: str, sequence: int, subset: bytes) -> pb.ContributeSubsetsRequest:
    """Return the message that sends an encoded subset."""
    return pb.ContributeSubsetsRequest(session_id=session_id, sequence=sequence, subset=subset)


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
        await self._call.write(update_request(self._session_id, self._sequence, subset))
        response = await self._call.read()
        if not isinstance(response, pb.ContributeSubsetsResponse):
            raise CodecError(f"subset {self._sequence}: expected an acknowledgement, got the end of the stream")
        if response.outcomes[0].status != pb.SUBSET_STATUS_ACCEPTED:
            raise CodecError(f"subset {self._sequence}: {response.outcomes[0].message or 'not accepted'}")

    async def close(self) -> None:
        """End the stream."""
        await self._call.done_writing()

    async def resend_forever(self, subset: bytes) -> None:
        """Send the same subset as fast as flow control lets it pass, without waiting for acknowledgements."""

        async def requests() -> AsyncIterator[pb.ContributeSubsetsRequest]:
            while True:
                self._sequence += 1
                yield update_request(self._session_id, self._sequence, subset)

        async for _ in self._stub.ContributeSubsets(requests()):
            pass


def send_all(address: str, session_id: str, subsets: Iterable[bytes]) -> None:
    """Send encoded subsets of a session, one after the other. Raises CodecError for one that is not accepted."""

    async def send() -> None:
        async with UpdateStreams(address) as streams:
            stream = streams.open(session_id)
            for subset in subsets:
                await stream.send(subset)
            await stream.close()

    asyncio.run(send())


class UpdateStreams(_Connection):
    """The connection to a fusion server."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._stub = pb_grpc.FusionServiceStub(self._channel)

    def open(self, session_id: str) -> UpdateStream:
        """Return a new stream of a session."""
        return UpdateStream(self._stub, session_id)

    async def report_objects(self, session_id: str, report: ObjectReport) -> bool:
        """Replace the agent's task and objects; returns whether the server has stored them."""
        try:
            await self._stub.ReportObjects(report_to_message(session_id, report))
        except grpc.RpcError:
            return False
        return True

    async def send_keyframe(self, session_id: str, keyframe: EncodedFrame) -> bool:
        """Send one keyframe; returns whether the server has stored it."""
        request = pb.ContributeKeyframesRequest(session_id=session_id, keyframe=keyframe)
        try:
            return bool((await self._stub.ContributeKeyframes(iter([request]))).accepted)
        except grpc.RpcError:
            return False
