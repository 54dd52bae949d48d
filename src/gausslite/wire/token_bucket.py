"""Keep a sender within a bandwidth."""

from __future__ import annotations

import time

_BURST_S = 1.0


class TokenBucket:
    """A bandwidth as a bucket of bytes that fills with time; it may go into debt by one batch."""

    def __init__(self, kbps: float | None) -> None:
        self._bytes_per_s = None if kbps is None else kbps * 125.0
        self._bytes = 0.0 if self._bytes_per_s is None else self._bytes_per_s * _BURST_S
        self._filled_s = time.monotonic()

    def seconds_until_positive(self, now_s: float) -> float:
        """How long until something may be sent."""
        if self._bytes_per_s is None:
            return 0.0
        gained = (now_s - self._filled_s) * self._bytes_per_s
        self._bytes, self._filled_s = min(self._bytes + gained, self._bytes_per_s * _BURST_S), now_s
        return max(0.0, -self._bytes / self._bytes_per_s)

    def room(self, at_most: int) -> int:
        """Bytes that may be sent now."""
        return at_most if self._bytes_per_s is None else max(1, min(at_most, int(self._bytes)))

    def spend(self, count: int) -> None:
        """Take bytes out of the bucket."""
        self._bytes -= count
