"""How much a caller may ask of a server: open calls, bandwidth, connections; a log of what was refused."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from gausslite.config.option import check_options, option
from gausslite.domain.errors import RateLimitError
from gausslite.wire.security import Caller, Role, caller_or_connection
from gausslite.wire.status import MAX_ERROR_CHARACTERS

_PERIOD_S = 60.0
_MAX_ENTRIES = 1000
_BURST_S = 1.0
MESSAGE_BYTES = 4096
"""The cost of a message beside its own bytes; it limits the rate of small messages."""
_RETRY_AFTER_S = 5.0
_LARGE_BYTES, _UNREAD_BYTES, _UNREAD_OF_ONE = 1 << 16, 128 << 20, 32 << 20
_READ_DEADLINE_S = 60.0
_HANDSHAKE_S = 10.0


class RejectionLog:
    """Counts refusals by caller and reason. Use it from one thread. clock_s: the time in seconds."""

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        # when each refusal was logged, and how often it has come since
        self._entries: OrderedDict[tuple[str, str], tuple[float, int]] = OrderedDict()

    def record(self, caller: str, reason: str, message: str) -> None:
        """Log a refusal, or count it for the next line about this caller and reason."""
        now_s, key, message = self._clock_s(), (caller, reason), message[:MAX_ERROR_CHARACTERS]
        if key not in self._entries:
            if len(self._entries) >= _MAX_ENTRIES:
                # a hostile network can have any number of addresses
                self._entries.popitem(last=False)
            self._entries[key] = now_s, 0
            self._log.warning("refused %s from %s: %s", reason, caller, message)
            return
        logged_s, count = self._entries[key]
        self._entries[key] = logged_s, count + 1
        period_s = now_s - logged_s
        if period_s >= _PERIOD_S:
            self._entries[key] = now_s, 0
            self._log.warning(
                "refused %s from %s: %d times in %.0f s, at last: %s", reason, caller, count + 1, period_s, message
            )


class TokenBucket:
    """A token bucket in bytes that fills with time; one batch may overdraw it."""

    def __init__(self, kbps: float | None) -> None:
        self._bytes_per_s = None if kbps is None else kbps * 125.0
        self._bytes = 0.0 if self._bytes_per_s is None else self._bytes_per_s * _BURST_S
        self._filled_s = time.monotonic()

    def seconds_until_positive(self, now_s: float) -> float:
        """Return the time until something may be sent."""
        if self._bytes_per_s is None:
            return 0.0
        added = (now_s - self._filled_s) * self._bytes_per_s
        self._bytes, self._filled_s = min(self._bytes + added, self._bytes_per_s * _BURST_S), now_s
        return max(0.0, -self._bytes / self._bytes_per_s)

    def is_full(self, now_s: float) -> bool:
        """Return whether nothing has been spent that is not filled up again."""
        if self._bytes_per_s is None:
            return True
        self.seconds_until_positive(now_s)
        return self._bytes >= self._bytes_per_s * _BURST_S

    def available_bytes(self, limit: int) -> int:
        """Return the number of bytes that may be sent now, from 1 to the limit."""
        return limit if self._bytes_per_s is None else max(1, min(limit, int(self._bytes)))

    def spend(self, count: int) -> None:
        """Remove bytes from the bucket."""
        self._bytes -= count


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Limits of a server; the number of connections is that of all callers together."""

    calls: int = 64  # open calls of one caller, streams and watchers included
    kbps: int = 200_000  # bandwidth of one caller's requests, in kilobits per second
    connections: int = option(1000, "largest number of connections", key="limit-connections", low=1)
    idle_s: int = 60  # time after which a connection without an open call is closed

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
    not limited: many agents and watchers share that address. Nor are servers, which send what many agents sent.
    """

    limits: CallLimits
    _usages: dict[str, _Usage] = field(default_factory=dict)
    _unread_bytes: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def open_call(self, caller: Caller) -> Iterator[TokenBucket | None]:
        """Count a call while it is open; gives the caller's bandwidth, None without a limit. Raises RateLimitError."""
        if (caller.names is None and caller.is_local) or Role.SERVER in caller.roles:
            yield None
            return
        self._forget_idle_callers()
        usage = self._usages.setdefault(caller.key, _Usage(TokenBucket(self.limits.kbps)))
        if usage.open_calls >= self.limits.calls:
            raise RateLimitError(
                f"calls: expected at most {self.limits.calls} open ones from {caller.key[:200]}; close some",
                retry_after_s=_RETRY_AFTER_S,
            )
        usage.open_calls += 1
        try:
            yield usage.bandwidth
        finally:
            usage.open_calls -= 1

    def require_read(self, context: Any) -> None:
        """Raise RateLimitError if the caller, or all together, have too much that they have not read."""
        caller = caller_or_connection(context)
        if self._unread_bytes[caller] > _UNREAD_OF_ONE or self._unread_bytes.total() > _UNREAD_BYTES:
            raise RateLimitError(
                f"answers: expected at most {_UNREAD_OF_ONE >> 20} MiB that are not read of a caller and "
                f"{_UNREAD_BYTES >> 20} of all, got {self._unread_bytes[caller] >> 20} of {caller[:200]} and "
                f"{self._unread_bytes.total() >> 20}; read them first",
                retry_after_s=_RETRY_AFTER_S,
            )

    def hold_answer(self, context: Any, answer_bytes: int) -> None:
        """Count a large answer until the caller has read it. The task that calls this ends if that is late."""
        task = asyncio.current_task()
        if answer_bytes < _LARGE_BYTES or task is None:
            return
        caller = caller_or_connection(context)
        self._unread_bytes[caller] += answer_bytes
        timer = asyncio.get_running_loop().call_later(_READ_DEADLINE_S, task.cancel)

        def release(_: Any) -> None:
            timer.cancel()
            self._unread_bytes -= Counter({caller: answer_bytes})

        context.add_done_callback(release)

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
