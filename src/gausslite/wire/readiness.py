"""Report NOT_SERVING while a service cannot do its work, and log each change once."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable

from gausslite.domain.errors import GaussLiteError

_log = logging.getLogger(__name__)
_CHECK_S = 30.0
_RETRY_S = 1.0
LIVENESS = "liveness"
"""A name that health checks answer with SERVING while the process runs, so that a full disk restarts no container."""
Check = Callable[[], None]
"""Raises GaussLiteError while the service cannot work. It may block; it runs in a thread."""


class ReadinessWatch:
    """Calls a service's check every 30 s, after `wake`, and every second while it fails. Use it on the event loop."""

    def __init__(self, service: str, check: Check, set_serving: Callable[[bool], Awaitable[None]]) -> None:
        self._service, self._check, self._set_serving = service, check, set_serving
        self._woken = asyncio.Event()
        self._failing_since_s: float | None = None

    def wake(self) -> None:
        """Check now, because a call has failed."""
        self._woken.set()

    async def run(self) -> None:
        """Check until the task is cancelled."""
        while True:
            interval_s = _CHECK_S if self._failing_since_s is None else _RETRY_S
            if self._failing_since_s is not None:
                # calls that fail meanwhile must not shorten the interval
                await asyncio.sleep(interval_s)
            else:
                await _wait_at_most(self._woken, interval_s)
            self._woken.clear()
            try:
                await asyncio.to_thread(self._check)
            except GaussLiteError as error:
                await self._record_failure(error)
            else:
                await self._record_success()

    async def _record_failure(self, error: GaussLiteError) -> None:
        if self._failing_since_s is None:
            self._failing_since_s = time.monotonic()
            _log.error("%s is NOT_SERVING: %s", self._service, error)
            await self._set_serving(False)

    async def _record_success(self) -> None:
        if self._failing_since_s is not None:
            _log.info("%s is SERVING again after %.0f s", self._service, time.monotonic() - self._failing_since_s)
            self._failing_since_s = None
            await self._set_serving(True)


async def _wait_at_most(event: asyncio.Event, timeout_s: float) -> None:
    try:
        await asyncio.wait_for(event.wait(), timeout_s)
    except TimeoutError:
        return
