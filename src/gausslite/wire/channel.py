"""One connection to a service: deadlines, retries of idempotent calls, message limits and encryption."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import grpc

from gausslite.domain.errors import UnavailableError
from gausslite.wire.address import require_callable
from gausslite.wire.connection import KEEPALIVE_S, connection_options
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import Tls, open_channel

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
        self._deadline_s = deadline_s
        methods = [
            {"service": service, "method": name} for service, names in _RETRIED_METHODS.items() for name in names
        ]
        config = {"methodConfig": [{"name": methods, "retryPolicy": _RETRY_POLICY}]}
        options = (
            ("grpc.service_config", json.dumps(config)),
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
            raise from_rpc_error(error, str(self)) from error

    def _call(self, method: Any, request: Any, deadline_s: float | None = None) -> Any:
        self._require_open()
        with self._convert_errors():
            return method(request, timeout=self._deadline_s if deadline_s is None else deadline_s)

    def _stream(self, method: Any, request: Any, deadline_s: float | None = None) -> Iterator[Any]:
        """Start a call at once, and return the iterator of its answers."""
        self._require_open()
        return self._answers(method(request, timeout=deadline_s))

    def _exchange(self, method: Any, requests: Iterable[Any], deadline_s: float | None = None) -> Iterator[Any]:
        """Start a call with a stream of requests at once, and return the iterator of its answers."""
        reader = _RequestReader(requests)
        return self._ended_with(reader, self._stream(method, iter(reader), deadline_s))

    def _ended_with(self, reader: _RequestReader, answers: Iterator[Any]) -> Iterator[Any]:
        try:
            yield from answers
        finally:
            reader.wait()

    def _answers(self, call: Any) -> Iterator[Any]:
        try:
            with self._convert_errors():
                yield from call
        finally:
            call.cancel()

    def _require_open(self) -> None:
        if self._closed:
            raise UnavailableError(f"{self}: expected an open client, got one that was closed")


class _RequestReader:
    """The requests of a call, and the thread in which gRPC reads them.

    A process that ends while this thread runs is aborted by gRPC, so the end of a call waits for it.
    """

    def __init__(self, requests: Iterable[Any]) -> None:
        self._requests = requests
        self._thread: threading.Thread | None = None

    def __iter__(self) -> Iterator[Any]:
        self._thread = threading.current_thread()
        yield from self._requests

    def wait(self) -> None:
        """Wait until the thread ends; it may still wait for the caller's next request."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_REQUESTS_END_S)
