"""Limit the bandwidth of a sender."""

from __future__ import annotations

import time

_BURST_S = 1.0


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
