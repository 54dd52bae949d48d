"""Choose one of the servers of a store for the work that only one may do, such as the estimation of frames."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock

LEADERSHIP_S = 10.0
"""A leader that has not renewed its leadership for this time has lost it."""


class Leadership:
    """Grants the leadership to the first server that asks, until it stops asking. Thread-safe.

    It is in memory. After a restart another server may get it while the earlier leader still works; both then estimate
    the same frames, and the later record stands. clock_s: the time in seconds.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s, self._lock = clock_s, Lock()
        self._leader, self._end_s = "", -float("inf")

    def ask(self, server_id: str) -> bool:
        """Return whether this server leads for the next 10 s."""
        with self._lock:
            now_s = self._clock_s()
            if self._leader != server_id and now_s < self._end_s:
                return False
            self._leader, self._end_s = server_id, now_s + LEADERSHIP_S
            return True
