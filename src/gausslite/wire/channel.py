"""One connection to a service: deadlines, retries of idempotent calls, message limits and encryption."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import grpc

from gausslite.wire.address import require_callable
from gausslite.wire.connection import KEEPALIVE_S, connection_options
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import Tls, open_channel
from gausslite.wire.tracing import traced_channel

DEADLINE_S = 30.0
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

    Calls raise a GaussLiteError for every error of the server or the network.
    """

    kind = "service"
    """The service's name in error messages."""
    keepalive_s = KEEPALIVE_S
    """A stream ends with UnavailableError twice this time after the last packet of a lost server."""

    def __init__(self, address: str, deadline_s: float = DEADLINE_S, tls: Tls | None = None) -> None:
        require_callable(f"{type(self).__name__} address", address)
        self.address = address
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
        self._channel = traced_channel(open_channel(address, tls, options))

    def __str__(self) -> str:
        """Return the kind and address, such as "parser localhost:50051"."""
        return f"{self.kind} {self.address}"

    def close(self) -> None:
        """Close the channel and cancel its calls."""
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
        with self._convert_errors():
            return method(request, timeout=self._deadline_s if deadline_s is None else deadline_s)

    def _stream(self, call: Any) -> Iterator[Any]:
        try:
            with self._convert_errors():
                yield from call
        finally:
            call.cancel()
