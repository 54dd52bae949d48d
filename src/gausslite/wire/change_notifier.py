"""Wake the streams that wait for news, however much of it there was."""

from __future__ import annotations

import asyncio


class ChangeNotifier:
    """Take a ticket, look at the state, then wait on the ticket: no ring between is missed, and many count as one."""

    def __init__(self) -> None:
        self._next_ring = asyncio.Event()

    def subscribe(self) -> asyncio.Event:
        """An event that the next ring sets."""
        return self._next_ring

    def notify(self) -> None:
        """Wake everyone who holds a ticket; call it on the event loop."""
        self._next_ring.set()
        self._next_ring = asyncio.Event()
