"""Start, drain and stop the gRPC server of a service.

Servicers raise GaussLite errors and write streams as async generators. The interceptor converts errors to status codes,
so that a servicer's method only decodes, calls and encodes. No client message can make the server exit.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import grpc
from google.protobuf.message import DecodeError
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from gausslite.domain.errors import GaussLiteError, InvalidInputError, QuotaError, StorageError, UnavailableError
from gausslite.process import handled_signals
from gausslite.wire import call_limits, security
from gausslite.wire.channel import KEEPALIVE_S, UNIX, connection_options, host_and_port
from gausslite.wire.status import code_and_reason, to_status

_log = logging.getLogger(__name__)
_CHECK_S, _RETRY_S = 30.0, 1.0
"""Between two checks of a service that works, and of one that does not."""
_CHECK_LIMIT_S = 5.0
"""A check that takes longer has failed: it waits for the same disk as the calls."""
LIVENESS = "liveness"
"""A name that health checks answer with SERVING while the process runs, so that a full disk restarts no container."""
Check = Callable[[], None]
"""Raises GaussLiteError while the service cannot work."""
_LAST_CALLS_S = 1.0
"""For cancelled calls to end."""
_MAX_UNARY_BYTES = 1 << 20
"""Decoded, empty parts of a message take forty times their bytes; images and voxels come in streams."""
_HEALTH_LIMITS = call_limits.CallLimits(connections=64, idle_s=10)
# the longest path of a unix socket that Linux accepts
_MAX_SOCKET_PATH_BYTES = 107
_OPTIONS = (
    *connection_options(KEEPALIVE_S),
    # gRPC would close a connection whose client pings this often without sending data
    ("grpc.http2.min_ping_interval_without_data_ms", round(500 * KEEPALIVE_S)),
    # else gRPC receives megabytes ahead on each stream, as fast as a client sends; a message that is read is exempt
    ("grpc.http2.bdp_probe", 0),
    # of one connection: a health watch or a reflection, which no limit of calls counts, takes 18 kB
    ("grpc.max_concurrent_streams", 512),
    # a second server must fail to bind the port instead of sharing it
    ("grpc.so_reuseport", 0),
)
_ARITY = {False: "unary", True: "stream"}


@dataclass(frozen=True, slots=True)
class Service:
    """A servicer's full name, a function that adds it to a server, and its checks."""

    name: str
    register: Callable[[grpc.aio.Server], None]
    check: Check = lambda: None  # may block; it runs in a thread
    check_progress: Check = lambda: None  # must not block; it is called every second


class ReadinessWatch:
    """Calls a service's check every 30 s, after `wake`, and every second while it fails. Use it on the event loop."""

    def __init__(self, service: Service, health_servicer: Any) -> None:
        self._service, self._health = service, health_servicer
        self._woken = asyncio.Event()
        self._checking: asyncio.Future[None] | None = None
        self._failing_since_s: float | None = None

    def wake(self) -> None:
        """Check now, because a call has failed."""
        self._woken.set()

    async def run(self) -> None:
        """Check until the task is cancelled."""
        next_check_s = time.monotonic() + _CHECK_S
        while True:
            if self._failing_since_s is not None:
                # calls that fail meanwhile must not shorten the interval
                await asyncio.sleep(_RETRY_S)
            else:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._woken.wait(), _RETRY_S)
            is_due = self._woken.is_set() or self._failing_since_s is not None or time.monotonic() >= next_check_s
            self._woken.clear()
            try:
                self._service.check_progress()
                if is_due:
                    await self._check_in_time()
                    next_check_s = time.monotonic() + _CHECK_S
            except GaussLiteError as error:
                if self._failing_since_s is None:
                    self._failing_since_s = time.monotonic()
                    _log.error("%s is NOT_SERVING: %s", self._service.name, error)
                    await self.set_serving(False)
            else:
                if self._failing_since_s is not None:
                    failed_s, self._failing_since_s = time.monotonic() - self._failing_since_s, None
                    _log.info("%s is SERVING again after %.0f s", self._service.name, failed_s)
                    await self.set_serving(True)

    async def set_serving(self, is_serving: bool) -> None:
        """Set the health of the service, and with it that of the whole server."""
        state = health_pb2.HealthCheckResponse.SERVING if is_serving else health_pb2.HealthCheckResponse.NOT_SERVING
        for name in ("", self._service.name):
            await self._health.set(name, state)

    async def _check_in_time(self) -> None:
        """Wait for the running check, or for a new one. Raises UnavailableError if it takes too long."""
        if self._checking is None:
            self._checking = asyncio.ensure_future(asyncio.to_thread(self._service.check))
        done, _ = await asyncio.wait([self._checking], timeout=_CHECK_LIMIT_S)
        if not done:
            raise UnavailableError(f"the check has not ended within {_CHECK_LIMIT_S:g} s")
        checked, self._checking = self._checking, None
        checked.result()


class RunningServer:
    """A running server. The addresses hold the actual ports; health_address is empty without an own address."""

    def __init__(
        self, servers: dict[str, grpc.aio.Server], health_servicer: Any, watches: Sequence[asyncio.Task[None]]
    ) -> None:
        self._servers = tuple(servers.values())
        self._health = health_servicer
        self._watches = watches
        self.address, self.health_address = (*servers, "")[:2]

    async def stop(self, grace_s: float = 5.0) -> None:
        """Report NOT_SERVING, refuse new calls, and cancel the open ones after `grace_s`."""
        for watch in self._watches:
            watch.cancel()
        await asyncio.gather(*self._watches, return_exceptions=True)
        await self._health.enter_graceful_shutdown()
        await asyncio.gather(*(server.stop(grace_s) for server in self._servers))
        # gRPC prints a traceback for each call that the event loop cancels when it closes
        calls = asyncio.all_tasks() - {asyncio.current_task()}
        if calls:
            await asyncio.wait(calls, timeout=_LAST_CALLS_S)


async def start_server(
    listen: str,
    services: Sequence[Service],
    tls: security.Tls | None = None,
    limits: call_limits.CallLimits | None = None,
    health_listen: str | None = None,
) -> RunningServer:
    """Serve on HOST:PORT (port 0 = any free port) or unix:PATH, with health and reflection; encrypted with `tls`.

    limits: of each caller, None for the default ones. health_listen: an address that serves only the health, without
    encryption, so that connections to the other one cannot keep health checks out; None for no such address.
    Raises UnavailableError if the address is in use, InvalidInputError if it is not an address.
    """
    limits = limits or call_limits.CallLimits()
    health_servicer = health.aio.HealthServicer()  # type: ignore[attr-defined]
    watches = [ReadinessWatch(service, health_servicer) for service in services]
    interceptor = CallInterceptor(call_limits.CallUsage(limits), watches)
    server = grpc.aio.server(interceptors=[interceptor], options=(*_OPTIONS, *limits.connection_options))
    health_pb2_grpc.add_HealthServicer_to_server(health_servicer, server)
    for service, watch in zip(services, watches, strict=True):
        service.register(server)
        await watch.set_serving(True)
    await health_servicer.set(LIVENESS, health_pb2.HealthCheckResponse.SERVING)
    names = [service.name for service in services]
    reflection.enable_server_reflection([*names, health.SERVICE_NAME, reflection.SERVICE_NAME], server)
    servers = {_bind(server, listen, tls): server}
    if health_listen is not None:
        health_server = grpc.aio.server(options=(*_OPTIONS, *_HEALTH_LIMITS.connection_options))
        health_pb2_grpc.add_HealthServicer_to_server(health_servicer, health_server)
        servers[_bind(health_server, health_listen, None)] = health_server
    for started in servers.values():
        await started.start()
    return RunningServer(servers, health_servicer, [asyncio.create_task(watch.run()) for watch in watches])


async def serve_until_stopped(
    listen: str,
    services: Sequence[Service],
    background_task: Callable[[], Awaitable[None]] | None = None,
    tls: security.Tls | None = None,
    limits: call_limits.CallLimits | None = None,
    health_listen: str | None = None,
) -> None:
    """Serve until a signal, or until the background task ends; then drain the server. Logs the addresses.

    Raises the errors of the background task, also those raised during its cancellation.
    """
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in handled_signals():
        loop.add_signal_handler(number, stopping.set)
    running = await start_server(listen, services, tls, limits, health_listen)
    service_names = ", ".join(service.name for service in services)
    _log.info("%s listening on %s%s", service_names, running.address, "" if tls is None else ", encrypted")
    if running.health_address:
        _log.info("health checks on %s", running.health_address)
    waits: list[asyncio.Future[Any]] = [asyncio.ensure_future(stopping.wait())]
    if background_task is not None:
        waits.append(asyncio.ensure_future(background_task()))
    try:
        done, _ = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in waits:
            task.cancel()
        results = await asyncio.gather(*waits, return_exceptions=True)
        await running.stop()
        _log.info("ended")
    for result in results:
        # an error during the cancellation of the background task must reach the caller
        if isinstance(result, GaussLiteError):
            raise result


@dataclass(frozen=True, slots=True)
class _Method:
    """A method of a servicer, by its full name."""

    name: str
    handler: Any

    async def read_stream(self, context: Any, bandwidth: call_limits.TokenBucket | None) -> AsyncIterator[Any]:
        """Yield the requests at the caller's bandwidth; HTTP/2's flow control then slows the caller down."""
        # gRPC's iterator would keep the bytes of a request while the method works on it
        while (data := await context.read()) is not grpc.aio.EOF:  # type: ignore[attr-defined]
            await call_limits.wait_for_bandwidth(bandwidth, len(data))
            request = self.decode(data)
            del data
            yield request

    def decode(self, data: bytes) -> Any:
        """Return the request. Raises InvalidInputError, QuotaError."""
        is_large = self.handler.request_streaming or security.ROLES_OF_METHOD.get(self.name) == frozenset(
            {security.Role.SERVER}
        )
        if len(data) > _MAX_UNARY_BYTES and not is_large:
            raise QuotaError(f"{self.name}: expected a request of at most {_MAX_UNARY_BYTES} bytes, got {len(data)}")
        try:
            return self.handler.request_deserializer(data)
        except DecodeError as error:
            raise InvalidInputError(
                f"{self.name}: expected its request message, got {len(data)} invalid bytes"
            ) from error


class CallInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]
    """Check role and limits of a call, and end it with its error's status; unexpected ones are INTERNAL and logged."""

    def __init__(self, usage: call_limits.CallUsage, watches: Sequence[ReadinessWatch] = ()) -> None:
        self._usage, self._watches = usage, watches
        self._rejections = call_limits.RejectionLog(_log)

    async def intercept_service(self, continuation: Callable[[Any], Awaitable[Any]], handler_call_details: Any) -> Any:
        """Return a handler that runs the called method and converts its errors; foreign services stay unchanged."""
        handler = await continuation(handler_call_details)
        call = _Method(handler_call_details.method, handler)
        if handler is None or not call.name.startswith("/gausslite."):
            return handler
        kind = f"{_ARITY[handler.request_streaming]}_{_ARITY[handler.response_streaming]}"
        inner = getattr(handler, kind)

        async def answer(request: Any, context: Any) -> Any:
            async with self._admit(call, request, context) as decoded:
                response = await inner(decoded, context)
                self._usage.hold_answer(context, response.ByteSize())
                return response

        async def answer_stream(request: Any, context: Any) -> AsyncIterator[Any]:
            async with self._admit(call, request, context) as decoded:
                async for response in inner(decoded, context):
                    yield response

        # requests are decoded inside, because gRPC itself would answer UNKNOWN to an invalid message
        message_codecs = {"request_deserializer": None, "response_serializer": handler.response_serializer}
        answers = answer_stream if handler.response_streaming else answer
        return getattr(grpc, f"{kind}_rpc_method_handler")(answers, **message_codecs)

    @contextlib.asynccontextmanager
    async def _admit(self, call: _Method, request: Any, context: Any) -> AsyncIterator[Any]:
        """Give the decoded request, or stream of requests, at the caller's bandwidth; an error ends the call."""
        try:
            caller = security.Caller.of(context)
            security.require_role(call.name, caller)
            self._usage.require_read(context)
            with self._usage.open_call(caller) as bandwidth:
                if call.handler.request_streaming:
                    yield call.read_stream(context, bandwidth)
                else:
                    await call_limits.wait_for_bandwidth(bandwidth, len(request))
                    yield call.decode(request)
        except Exception as error:
            await self._abort(call.name, error, context)

    async def _abort(self, method: str, error: Exception, context: Any) -> NoReturn:
        if isinstance(error, grpc.aio.AbortError):
            raise error
        if not isinstance(error, GaussLiteError):
            _log.error("%s failed: %s: %s", method, type(error).__name__, error, exc_info=error)
            error = GaussLiteError(f"{method}: unexpected error in the server; see its log")
        elif isinstance(error, StorageError):
            # the watch logs it once, not for every call
            for watch in self._watches:
                watch.wake()
        elif not isinstance(error, UnavailableError):
            self._rejections.record(security.Caller.of(context).key, code_and_reason(error)[1], str(error))
        await context.abort_with_status(to_status(error))
        raise error


def _bind(server: grpc.aio.Server, listen: str, tls: security.Tls | None) -> str:
    """Let the server listen; returns the address with the actual port. Raises UnavailableError, InvalidInputError."""
    _require_free_address(listen)
    try:
        port = (
            server.add_insecure_port(listen)
            if tls is None
            else server.add_secure_port(listen, tls.server_credentials())
        )
    except RuntimeError:
        port = 0
    if port == 0:
        raise UnavailableError(f"listen {listen}: the address is in use or cannot be bound; choose another")
    return listen if listen.startswith(UNIX) else f"{listen.rpartition(':')[0]}:{port}"


def _require_free_address(listen: str) -> None:
    """Raise UnavailableError if the address is in use.

    Without this check gRPC would replace the unix socket of a running server. For a port in use it would also write its
    own messages to stderr.
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
        raise UnavailableError(f"listen {listen}: a file with this name exists; choose another path")
    if not os.access(path.parent, os.W_OK):
        raise UnavailableError(f"listen {listen}: expected a path in a folder that can be written; choose another")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        if probe.connect_ex(str(path)) == 0:
            raise UnavailableError(f"listen {listen}: another server listens on this socket; choose another")
