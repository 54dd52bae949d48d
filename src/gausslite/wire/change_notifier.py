"""Wake streams that wait for a change; several changes in between count as one."""

from __future__ import annotations

import asyncio


class ChangeNotifier:
    """Subscribe, read the state, then wait on the subscription: so no change is missed. Use it on the event loop."""

    def __init__(self) -> None:
        self._next_change = asyncio.Event()

    def subscribe(self) -> asyncio.Event:
        """Return an event that the next `notify` sets."""
        return self._next_change

    def notify(self) -> None:
        """Wake all subscribers."""
        self._next_change.set()
        self._next_change = asyncio.Event()
