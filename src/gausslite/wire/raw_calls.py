"""Call the methods of the services with any bytes, in one asyncio loop; fuzzing uses it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence

import grpc

from gausslite.v1 import agent_service_pb2, fusion_service_pb2, parser_service_pb2
from gausslite.wire.address import require_callable

ENDED_WHILE_SENDING = "ENDED_WHILE_SENDING"
_LOCAL_ERROR = "Internal error from Core"
"""What grpc.aio makes up when the server has ended a call and a message cannot be written any more."""
_MODULES = (agent_service_pb2, fusion_service_pb2, parser_service_pb2)


def service_methods() -> dict[str, dict[str, bool]]:
    """Return the methods of each service, by its full name, and whether a method takes a stream of requests."""
    services = [each for module in _MODULES for each in module.DESCRIPTOR.services_by_name.values()]
    return {each.full_name: {method.name: method.client_streaming for method in each.methods} for each in services}


class RawCalls:
    """Owns a connection to one service; an asynchronous context manager. Raises InvalidInputError for its address."""

    def __init__(self, address: str, service: str) -> None:
        require_callable("RawCalls address", address)
        self._service = service
        self._channel = grpc.aio.insecure_channel(address)

    async def __aenter__(self) -> RawCalls:
        return self

    async def __aexit__(self, *exception: object) -> None:
        await self._channel.close(None)

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
