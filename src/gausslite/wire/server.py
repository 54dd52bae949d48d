"""Start, watch and end a gRPC server: one way for all three services.

Servicers raise our errors and write their streams as async generators; the interceptor here turns errors into status,
so that a method is decode, call, encode, and no message ends the server.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import grpc
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from gausslite.errors import GaussLiteError, InvalidInputError, UnavailableError
from gausslite.wire.address import UNIX, host_and_port
from gausslite.wire.status import to_status
from gausslite.wire.tls import Tls

MAX_MESSAGE_BYTES = 16 << 20
"""Both ends refuse more; a frame of two megapixels with PNG depth fits several times."""

SILENCE_S = 15.0
"""After so long without a byte either end of a connection asks whether the other is there, and waits as long for it."""


def connection_options(silence_s: float) -> tuple[tuple[str, int], ...]:
    """What both ends of a connection are set to.

    Who only listens, such as a watcher, sends nothing, and would wait for ever on a network that went away silently.
    """
    return (
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.keepalive_time_ms", round(1000 * silence_s)),
        ("grpc.http2.ping_timeout_ms", round(1000 * silence_s)),
        ("grpc.http2.max_pings_without_data", 0),
    )


_log = logging.getLogger(__name__)
# what the system keeps of a unix socket's path
_MAX_SOCKET_PATH_BYTES = 107
_OPTIONS = (
    *connection_options(SILENCE_S),
    # callers ask as often, and on streams that are quiet for hours
    ("grpc.http2.min_ping_interval_without_data_ms", round(500 * SILENCE_S)),
    # a second server on the port must fail, not share it
    ("grpc.so_reuseport", 0),
)


@dataclass(frozen=True, slots=True)
class Service:
    """A servicer ready to be added: its full name and the generated function that adds it, already bound."""

    name: str
    register: Callable[[grpc.aio.Server], None]


class RunningServer:
    """A server that answers. `address` has the real port; `stop` lets calls in flight end."""

    def __init__(self, server: grpc.aio.Server, address: str, health_servicer: Any) -> None:
        self._server = server
        self._health = health_servicer
        self.address = address

    async def stop(self, grace_s: float = 5.0) -> None:
        """Say NOT_SERVING, refuse new calls, give those in flight `grace_s`, then cancel them."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_s)


async def start_server(listen: str, services: Sequence[Service], tls: Tls | None = None) -> RunningServer:
    """Serve on HOST:PORT (port 0 = any free one) or unix:PATH, with health and reflection; encrypted with `tls`.

    Raises UnavailableError when the address is taken, InvalidInputError when it is none.
    """
    _require_free(listen)
    server = grpc.aio.server(interceptors=[ErrorInterceptor()], options=_OPTIONS)
    health_servicer = health.aio.HealthServicer()  # type: ignore[attr-defined]
    health_pb2_grpc.add_HealthServicer_to_server(health_servicer, server)
    for service in services:
        service.register(server)
        await health_servicer.set(service.name, health_pb2.HealthCheckResponse.SERVING)
    await health_servicer.set("", health_pb2.HealthCheckResponse.SERVING)
    names = [service.name for service in services]
    reflection.enable_server_reflection([*names, health.SERVICE_NAME, reflection.SERVICE_NAME], server)
    try:
        port = server.add_insecure_port(listen) if tls is None else server.add_secure_port(listen, tls.of_server())
    except RuntimeError:
        port = 0
    if port == 0:
        raise UnavailableError(f"listen {listen}: the address is in use or cannot be bound; choose another")
    await server.start()
    address = listen if listen.startswith("unix:") else f"{listen.rpartition(':')[0]}:{port}"
    return RunningServer(server, address, health_servicer)


async def serve_until_stopped(
    listen: str,
    services: Sequence[Service],
    until: Callable[[], Awaitable[None]] | None = None,
    tls: Tls | None = None,
    grace_s: float = 5.0,
) -> None:
    """Serve until SIGTERM or SIGINT, or until `until` returns; then drain. Prints nothing; logs where it listens.

    Raises what `until` raises, also while it is being cancelled.
    """
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stopping.set)
    running = await start_server(listen, services, tls)
    names = ", ".join(service.name for service in services)
    _log.info("%s listening on %s%s", names, running.address, "" if tls is None else ", encrypted")
    waits: list[asyncio.Future[Any]] = [asyncio.ensure_future(stopping.wait())]
    if until is not None:
        waits.append(asyncio.ensure_future(until()))
    try:
        done, _ = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in waits:
            task.cancel()
        ends = await asyncio.gather(*waits, return_exceptions=True)
        await running.stop(grace_s)
        _log.info("ended")
    for end in ends:
        # what went wrong while `until` was ending must not pass for a clean end
        if isinstance(end, GaussLiteError):
            raise end


class ErrorInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]
    """Ends a call with the status of the error its method raised; anything unforeseen is INTERNAL and logged."""

    async def intercept_service(
        self,
        continuation: Callable[[Any], Awaitable[Any]],
        handler_call_details: Any,
    ) -> Any:
        """Wrap the method that is about to be called."""
        handler = await continuation(handler_call_details)
        method = handler_call_details.method
        if handler is None or not method.startswith("/gausslite."):
            return handler
        # bytes come as they are and are read behind the guard: gRPC itself would answer UNKNOWN to what is no message
        serializers = {"request_deserializer": None, "response_serializer": handler.response_serializer}
        read = _reader(handler.request_deserializer, method, handler.request_streaming)
        if handler.response_streaming:
            inner = handler.stream_stream if handler.request_streaming else handler.unary_stream
            make = (
                grpc.stream_stream_rpc_method_handler
                if handler.request_streaming
                else grpc.unary_stream_rpc_method_handler
            )
            return make(_guard_stream(inner, read, method), **serializers)
        inner = handler.stream_unary if handler.request_streaming else handler.unary_unary
        make = (
            grpc.stream_unary_rpc_method_handler if handler.request_streaming else grpc.unary_unary_rpc_method_handler
        )
        return make(_guard_unary(inner, read, method), **serializers)


def _reader(deserialize: Callable[[bytes], Any], method: str, streaming: bool) -> Callable[[Any], Any]:
    def one(data: bytes) -> Any:
        try:
            return deserialize(data)
        except DecodeError as error:
            raise InvalidInputError(f"{method}: expected its request message, got {len(data)} other bytes") from error

    async def each(stream: AsyncIterator[bytes]) -> AsyncIterator[Any]:
        async for data in stream:
            yield one(data)

    return each if streaming else one


def _guard_unary(inner: Any, read: Callable[[Any], Any], method: str) -> Any:
    async def guarded(request: Any, context: Any) -> Any:
        try:
            return await inner(read(request), context)
        except Exception as error:
            await _abort(error, method, context)

    return guarded


def _guard_stream(inner: Any, read: Callable[[Any], Any], method: str) -> Any:
    async def guarded(request: Any, context: Any) -> AsyncIterator[Any]:
        try:
            async for response in inner(read(request), context):
                yield response
        except Exception as error:
            await _abort(error, method, context)

    return guarded


async def _abort(error: Exception, method: str, context: Any) -> NoReturn:
    if isinstance(error, grpc.aio.AbortError):
        raise error
    if not isinstance(error, GaussLiteError):
        _log.error("%s failed: %s: %s", method, type(error).__name__, error, exc_info=error)
        error = GaussLiteError(f"{method}: the server met an unforeseen error; its log has the details")
    await context.abort_with_status(to_status(error))
    raise error


def _require_free(listen: str) -> None:
    """Try the address first: gRPC takes over a unix socket that another server still answers on, and writes lines of
    its own to stderr about a port in use.
    """
    if listen.startswith(UNIX):
        _require_free_socket(listen, Path(listen.removeprefix(UNIX)))
        return
    host, port = host_and_port("listen", listen)
    try:
        resolved = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in resolved:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except OSError as error:
        raise UnavailableError(f"listen {listen}: {error.strerror or error}; choose another address") from error


def _require_free_socket(listen: str, path: Path) -> None:
    if not path.name or len(str(path).encode(errors="surrogateescape")) > _MAX_SOCKET_PATH_BYTES:
        raise InvalidInputError(
            f"listen {listen[:80]}: expected unix:PATH with a path of 1 to {_MAX_SOCKET_PATH_BYTES} bytes"
        )
    if path.exists() and not path.is_socket():
        raise UnavailableError(f"listen {listen}: a file is in the way; choose another path")
    if not os.access(path.parent, os.W_OK):
        raise UnavailableError(f"listen {listen}: expected a path in a folder that can be written; choose another")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        if probe.connect_ex(str(path)) == 0:
            raise UnavailableError(f"listen {listen}: another server answers on this socket; choose another")
