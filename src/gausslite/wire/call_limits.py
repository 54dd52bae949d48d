"""Limit what one caller takes of a server: open calls and bandwidth; and the connections of all callers together."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from gausslite.config.option import check_options, option
from gausslite.domain.errors import RateLimitError
from gausslite.wire.caller import Caller
from gausslite.wire.token_bucket import TokenBucket

MESSAGE_BYTES = 4096
"""The cost of a message beside its own bytes; it limits the rate of small messages."""
_RETRY_AFTER_S = 5.0
_HANDSHAKE_S = 10.0


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Limits of a server.

    calls: open calls of one caller, streams and watchers included; kbps: bandwidth of one caller's requests, in
    kilobits per second; connections: of all callers together; idle_s: time after which a connection without an open
    call is closed.
    """

    calls: int = option(64, "largest number of open calls of one caller", key="limit-calls", low=1)
    kbps: int = option(200_000, "largest bandwidth of one caller's requests", key="limit-kbps", unit="kbit/s", low=1)
    connections: int = option(1000, "largest number of connections", key="limit-connections", low=1)
    idle_s: int = option(60, "longest time of a connection without a call", key="limit-idle", unit="s", low=1)

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def connection_options(self) -> tuple[tuple[str, int], ...]:
        """The gRPC options of a server."""
        return (
            ("grpc.max_allowed_incoming_connections", self.connections),
            ("grpc.max_connection_idle_ms", 1000 * self.idle_s),
            ("grpc.server_handshake_timeout_ms", round(1000 * _HANDSHAKE_S)),
        )


@dataclass(slots=True)
class _Usage:
    bandwidth: TokenBucket
    open_calls: int = 0


@dataclass(slots=True)
class CallUsage:
    """The open calls and the bandwidth of each caller. Use it on the event loop only.

    A caller is a certificate, or an address without one. Programs on the server's machine without a certificate are
    not limited: many agents and watchers share that address.
    """

    limits: CallLimits
    _usages: dict[str, _Usage] = field(default_factory=dict)

    @contextmanager
    def open_call(self, caller: Caller) -> Iterator[TokenBucket | None]:
        """Count a call while it is open; gives the caller's bandwidth, None without a limit. Raises RateLimitError."""
        if caller.names is None and caller.is_local:
            yield None
            return
        self._forget_idle_callers()
        usage = self._usages.setdefault(caller.key, _Usage(TokenBucket(self.limits.kbps)))
        if usage.open_calls >= self.limits.calls:
            error = RateLimitError(
                f"calls: expected at most {self.limits.calls} open ones from {caller.key[:200]}; close some"
            )
            error.retry_after_s = _RETRY_AFTER_S
            raise error
        usage.open_calls += 1
        try:
            yield usage.bandwidth
        finally:
            usage.open_calls -= 1

    def _forget_idle_callers(self) -> None:
        """Delete what is known of callers that use nothing, so that many addresses do not fill the memory."""
        now_s = time.monotonic()
        idle = [key for key, usage in self._usages.items() if usage.open_calls == 0 and usage.bandwidth.is_full(now_s)]
        for key in idle:
            del self._usages[key]


async def wait_for_bandwidth(bandwidth: TokenBucket | None, message_bytes: int) -> None:
    """Spend the cost of a request, and wait while the caller has spent more than its bandwidth."""
    if bandwidth is None:
        return
    bandwidth.spend(MESSAGE_BYTES + message_bytes)
    while (wait_s := bandwidth.seconds_until_positive(time.monotonic())) > 0:
        await asyncio.sleep(wait_s)


async def limit_stream(requests: AsyncIterator[bytes], bandwidth: TokenBucket | None) -> AsyncIterator[bytes]:
    """Yield the requests at the caller's bandwidth; HTTP/2's flow control then slows the caller down."""
    async for data in requests:
        await wait_for_bandwidth(bandwidth, len(data))
        yield data
