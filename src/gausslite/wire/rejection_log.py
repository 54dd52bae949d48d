"""Log what a server refuses: the first case at once, then one line a minute per caller and reason."""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

_PERIOD_S = 60.0
_MAX_ENTRIES = 1000


@dataclass(slots=True)
class _Entry:
    logged_s: float
    count: int = 0


class RejectionLog:
    """Counts refusals by caller and reason. Use it from one thread. clock_s: the time in seconds."""

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        self._entries: OrderedDict[tuple[str, str], _Entry] = OrderedDict()

    def record(self, caller: str, reason: str, message: str) -> None:
        """Log a refusal, or count it for the next line about this caller and reason."""
        now_s, key = self._clock_s(), (caller, reason)
        entry = self._entries.get(key)
        if entry is None:
            if len(self._entries) >= _MAX_ENTRIES:
                # a hostile network can have any number of addresses
                self._entries.popitem(last=False)
            self._entries[key] = _Entry(now_s)
            self._log.warning("refused %s from %s: %s", reason, caller, message)
            return
        entry.count += 1
        if now_s - entry.logged_s >= _PERIOD_S:
            period_s, entry.logged_s = now_s - entry.logged_s, now_s
            self._log.warning(
                "refused %s from %s: %d times in %.0f s, at last: %s", reason, caller, entry.count, period_s, message
            )
            entry.count = 0
