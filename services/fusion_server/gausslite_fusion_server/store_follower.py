"""Follow what other fusion servers write to the store that they share with this one."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import NoReturn, Protocol, runtime_checkable

from gausslite.domain.errors import GaussLiteError
from gausslite.fusion.engine import FusionEngine

_log = logging.getLogger(__name__)
_PERIOD_S = 0.1
_PERIODS_TO_RENEW = 30


@runtime_checkable
class ServerLeadership(Protocol):
    """Knows which server, of those that share a store, estimates the agents' frames."""

    def leads(self) -> bool:
        """Return whether it is this server."""
        ...

    def renew(self) -> None:
        """Ask for the leadership again; call it every few seconds. Raises UnavailableError."""
        ...


async def follow_store(engine: FusionEngine, leadership: ServerLeadership, notify: Callable[[], None]) -> NoReturn:
    """Apply the other servers' changes until the task is cancelled; notify: called after changes."""
    period = 0
    while True:
        try:
            if period % _PERIODS_TO_RENEW == 0:
                await asyncio.to_thread(leadership.renew)
                await asyncio.to_thread(engine.save_leases)
            if await asyncio.to_thread(engine.follow):
                notify()
        except GaussLiteError as error:
            _log.warning("changes by other servers are late: %s", error)
        period += 1
        await asyncio.sleep(_PERIOD_S)
