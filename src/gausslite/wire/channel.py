"""One connection to a service: deadlines, retries where a call may be said twice, limits, and encryption."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import grpc

from gausslite.wire.server import SILENCE_S, connection_options
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import Tls, open_channel

DEADLINE_S = 30.0
_RETRIED = {
    "gausslite.v1.ParserService": ("ParseTask",),
    "gausslite.v1.AgentService": ("AssignTask", "GetAgentStatus", "RenderView"),
    "gausslite.v1.FusionService": ("JoinSession", "GetSessionStatus", "LeaveSession"),
}
_RETRY_POLICY = {
    "maxAttempts": 4,
    "initialBackoff": "0.2s",
    "maxBackoff": "2s",
    "backoffMultiplier": 2,
    "retryableStatusCodes": ["UNAVAILABLE"],
}
_Kind = TypeVar("_Kind", bound="ServiceChannel")


class ServiceChannel:
    """Owns one channel, encrypted with `tls`. Raises our errors for what the server or the transport says."""

    kind = "service"
    """What answers there, in an operator's words."""
    silence_s = SILENCE_S
    """When a stream ends, with UnavailableError, on which nothing comes: twice this after the last sign of life."""

    def __init__(self, address: str, deadline_s: float = DEADLINE_S, tls: Tls | None = None) -> None:
        self.address = address
        self._deadline_s = deadline_s
        methods = [{"service": service, "method": name} for service, names in _RETRIED.items() for name in names]
        config = {"methodConfig": [{"name": methods, "retryPolicy": _RETRY_POLICY}]}
        options = (
            ("grpc.service_config", json.dumps(config)),
            *connection_options(self.silence_s),
            ("grpc.max_reconnect_backoff_ms", 2000),
        )
        self._channel = open_channel(address, tls, options)

    def __str__(self) -> str:
        """Such as "parser localhost:50051", for an operator who gave several addresses."""
        return f"{self.kind} {self.address}"

    def close(self) -> None:
        """End the channel and every call on it."""
        self._channel.close()

    def __enter__(self: _Kind) -> _Kind:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @contextmanager
    def _our_errors(self) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise from_rpc_error(error, str(self)) from error

    def _call(self, method: Any, request: Any, deadline_s: float | None = None) -> Any:
        with self._our_errors():
            return method(request, timeout=self._deadline_s if deadline_s is None else deadline_s)

    def _stream(self, call: Any) -> Iterator[Any]:
        try:
            with self._our_errors():
                yield from call
        finally:
            call.cancel()
