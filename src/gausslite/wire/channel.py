"""One connection to a service: address, deadlines, retries of idempotent calls, limits, encryption and health."""

from __future__ import annotations

import ipaddress
import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.domain.errors import GaussLiteError, InvalidInputError, RateLimitError, UnavailableError
from gausslite.wire.security import Tls
from gausslite.wire.status import from_rpc_error, has_reason

PARSER_ADDRESS = "127.0.0.1:50051"
FUSION_ADDRESS = "127.0.0.1:50052"
AGENT_ADDRESS = "127.0.0.1:50053"
"""The addresses on which the services listen by default."""
UNIX = "unix:"
MAX_PORT = 65535
_WEB_SCHEMES = ("http://", "https://")
_PROXY_VARIABLES = ("grpc_proxy", "https_proxy", "http_proxy")
"""The variables from which gRPC takes a proxy, in its order."""
MAX_MESSAGE_BYTES = 16 << 20
"""Both ends refuse larger messages; a frame of two megapixels with PNG depth needs a fraction of it."""
KEEPALIVE_S = 15.0
"""Either end sends a ping after this time without data, and closes the connection if no answer comes within it."""
DEADLINE_S = 30.0
_REQUESTS_END_S = 1.0
_RETRIED_METHODS = {
    "gausslite.v1.ParserService": ("ParseTask",),
    "gausslite.v1.AgentService": ("AssignTask", "EndMission", "GetAgentStatus", "RenderView"),
    "gausslite.v1.FusionService": ("JoinSession", "GetSessionStatus", "QueryObjects", "ReportObjects", "LeaveSession"),
}
_RETRY_POLICY = {
    "maxAttempts": 4,
    "initialBackoff": "0.2s",
    "maxBackoff": "2s",
    "backoffMultiplier": 2,
    "retryableStatusCodes": ["UNAVAILABLE"],
}
_METHODS = [{"service": service, "method": name} for service, names in _RETRIED_METHODS.items() for name in names]
_SERVICE_CONFIG = json.dumps({"methodConfig": [{"name": _METHODS, "retryPolicy": _RETRY_POLICY}]})
_Response = TypeVar("_Response")
_HEALTH_DEADLINE_S = 3.0
_SERVING = health_pb2.HealthCheckResponse.SERVING
_MAX_BACKOFF_S = 5.0
_MAX_RETRY_HINT_S = 60.0


def host_and_port(name: str, address: str) -> tuple[str, int]:
    """Split HOST:PORT. Raises InvalidInputError; its message begins with the name."""
    for scheme in _WEB_SCHEMES:
        if address.startswith(scheme):
            raise InvalidInputError(f"{name}: expected HOST:PORT without {scheme}, got {address!r}")
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and len(port) <= 5) or int(port) > MAX_PORT:
        raise InvalidInputError(f"{name}: expected HOST:PORT or unix:PATH, got {address!r}")
    return host, int(port)


def require_callable(name: str, address: str) -> str:
    """Return the address. Raises InvalidInputError unless a service can listen there; gRPC would add port 443."""
    if not isinstance(address, str):
        raise InvalidInputError(f"{name}: expected HOST:PORT or unix:PATH as text, got {type(address).__name__}")
    is_socket = address.startswith(UNIX) and address != UNIX
    if not is_socket and host_and_port(name, address)[1] == 0:
        raise InvalidInputError(f"{name}: expected the port that the service listens on, got {address!r}")
    return address


def is_local(address: str) -> bool:
    """Return True for a service of this machine or network, which no proxy of the environment reaches.

    That is a unix socket, an address of a private network, and a name without a domain or with .local.
    """
    host = address.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_private
    except ValueError:
        return address.startswith(UNIX) or "." not in host or host.endswith((".local", ".localhost"))


def proxy_options(address: str) -> tuple[tuple[str, int], ...]:
    """Return the gRPC options of a connection that uses the proxy of the environment outside this network only."""
    return (("grpc.enable_http_proxy", 0),) if is_local(address) else ()


def _raised(error: grpc.RpcError, name: str, address: str) -> GaussLiteError:
    """Return the error of a call to the service of this name, with the variable whose proxy the connection used."""
    raised = from_rpc_error(error, name)
    variable = next((variable for variable in _PROXY_VARIABLES if os.environ.get(variable)), None)
    answered = isinstance(error, grpc.Call) and has_reason(error)
    if answered or not isinstance(raised, UnavailableError) or is_local(address) or variable is None:
        return raised
    return UnavailableError(f"{raised}; the variable {variable} states a proxy, no_proxy=HOST excludes a host from it")


def open_channel(address: str, tls: Tls | None, options: Sequence[tuple[str, Any]] = ()) -> grpc.Channel:
    """Open a channel, encrypted with `tls`. The server of a unix socket must have a certificate for localhost."""
    options = channel_options(address, tls, options)
    if tls is None:
        return grpc.insecure_channel(address, options=options)
    return grpc.secure_channel(address, tls.client_credentials(), options=options)


def channel_options(address: str, tls: Tls | None, options: Sequence[tuple[str, Any]]) -> list[tuple[str, Any]]:
    """Return the options with those that the address needs: no proxy within this network, the name of a socket."""
    is_unix = tls is not None and address.startswith(UNIX)
    name = [("grpc.ssl_target_name_override", "localhost")] if is_unix else []
    return [*options, *proxy_options(address), *name]


def connection_options(keepalive_s: float) -> tuple[tuple[str, int], ...]:
    """Return the gRPC options of either end; without pings, a watcher would not notice a lost network."""
    return (
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.keepalive_time_ms", round(1000 * keepalive_s)),
        ("grpc.http2.ping_timeout_ms", round(1000 * keepalive_s)),
        ("grpc.http2.max_pings_without_data", 0),
    )


_Client = TypeVar("_Client", bound="ServiceChannel")


class ServiceChannel:
    """Owns one channel, encrypted with `tls`. Raises InvalidInputError for a malformed address.

    Calls raise a GaussLiteError for every error of the server or the network, and UnavailableError after `close`.
    """

    kind = "service"
    """The service's name in error messages."""
    keepalive_s = KEEPALIVE_S
    """A stream ends with UnavailableError twice this time after the last packet of a lost server."""

    def __init__(self, address: str, deadline_s: float = DEADLINE_S, tls: Tls | None = None) -> None:
        require_callable(f"{type(self).__name__} address", address)
        self.address = address
        self._closed = False
        self._deadline_s, self._tls = deadline_s, tls
        options = (
            ("grpc.service_config", _SERVICE_CONFIG),
            *connection_options(self.keepalive_s),
            ("grpc.max_reconnect_backoff_ms", 2000),
        )
        self._channel = open_channel(address, tls, options)

    def __str__(self) -> str:
        """Return the kind and address, such as "parser localhost:50051"."""
        return f"{self.kind} {self.address}"

    def close(self) -> None:
        """Close the channel and cancel its calls."""
        self._closed = True
        self._channel.close()

    def __enter__(self: _Client) -> _Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _convert_errors(self) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise _raised(error, str(self), self.address) from error

    def _call(self, method: Callable[..., _Response], request: Any, deadline_s: float | None = None) -> _Response:
        self._require_open()
        with self._convert_errors():
            return method(request, timeout=self._deadline_s if deadline_s is None else deadline_s)

    def _stream(
        self, method: Callable[..., Iterable[_Response]], request: Any, deadline_s: float | None = None
    ) -> Iterator[_Response]:
        """Start a call at once, and return the iterator of its answers."""
        self._require_open()
        return self._answers(method(request, timeout=deadline_s))

    def _exchange(
        self, method: Callable[..., Iterable[_Response]], requests: Iterable[Any], deadline_s: float | None = None
    ) -> Iterator[_Response]:
        """Start a call with a stream of requests at once, and return the iterator of its answers.

        An error of the requests' own iterator ends the call and is raised as it is.
        """
        self._require_open()
        reader = _RequestReader(requests)
        return self._answers(method(iter(reader), timeout=deadline_s), reader)

    def _answers(self, call: Any, reader: _RequestReader | None = None) -> Iterator[Any]:
        try:
            with self._convert_errors():
                yield from call
        except GaussLiteError:
            if reader is not None:
                call.cancel()
                reader.wait()
                if reader.error is not None:
                    # gRPC says only that there was one
                    raise reader.error from None
            raise
        finally:
            call.cancel()
            if reader is not None:
                reader.wait()

    def _require_open(self) -> None:
        if self._closed:
            raise UnavailableError(f"{self}: expected an open client, got one that was closed")


class _RequestReader:
    """The requests of a call; its end waits for the thread that reads them, or gRPC may abort the ending process."""

    def __init__(self, requests: Iterable[Any]) -> None:
        self._requests = requests
        self._thread: threading.Thread | None = None
        self.error: Exception | None = None

    def __iter__(self) -> Iterator[Any]:
        self._thread = threading.current_thread()
        try:
            yield from self._requests
        except Exception as error:
            self.error = error
            raise

    def wait(self) -> None:
        """Wait until the thread ends; it may still wait for the caller's next request."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_REQUESTS_END_S)


def require_serving(address: str, tls: Tls | None, service: str = "") -> None:
    """Raise UnavailableError if the service at this address does not answer SERVING within seconds."""
    if _status(address, service, tls) != _SERVING:
        raise UnavailableError(f"{address}: not serving")


def is_agent(address: str, tls: Tls | None) -> bool:
    """Return True for an agent's address, False for a fusion server's. Raises UnavailableError, InvalidInputError."""
    require_callable("address", address)
    for name in ("Agent", "Fusion"):
        if _status(address, f"gausslite.v1.{name}Service", tls) == _SERVING:
            return name == "Agent"
    raise InvalidInputError(f"{address}: expected an agent or a fusion server, got another service")


def _status(address: str, service: str, tls: Tls | None) -> int:
    """Return the health of the service, SERVICE_UNKNOWN if the server does not have it; "" is the whole server."""
    try:
        with open_channel(address, tls) as channel:
            request = health_pb2.HealthCheckRequest(service=service)
            return int(health_pb2_grpc.HealthStub(channel).Check(request, timeout=_HEALTH_DEADLINE_S).status)
    except grpc.RpcError as error:
        if error.code() is grpc.StatusCode.NOT_FOUND:
            return int(health_pb2.HealthCheckResponse.SERVICE_UNKNOWN)
        raise UnavailableError(str(_raised(error, address, address))) from None


class RetryDelay:
    """Exponential backoff. Not thread-safe."""

    def __init__(self, first_s: float) -> None:
        self._first_s, self._delay_s = first_s, 0.0

    def after(self, error: GaussLiteError) -> float:
        """Return the time until the next attempt in seconds."""
        self._delay_s = min(max(2 * self._delay_s, self._first_s), _MAX_BACKOFF_S)
        if isinstance(error, RateLimitError) and error.retry_after_s is not None:
            # the server states when it accepts the next message
            return min(max(self._delay_s, error.retry_after_s), _MAX_RETRY_HINT_S)
        return self._delay_s

    def reset(self) -> None:
        """Start again with the first delay, after a success."""
        self._delay_s = 0.0
