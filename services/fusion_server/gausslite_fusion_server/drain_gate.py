"""Let calls in while the server is up, and end the open ones when it drains."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import TypeVar

from gausslite.errors import UnavailableError

_Message = TypeVar("_Message")


class DrainGate:
    """Open until shut, once; used on the event loop only."""

    def __init__(self) -> None:
        self._shut = asyncio.Event()

    @property
    def is_open(self) -> bool:
        """False once the server drains."""
        return not self._shut.is_set()

    def shut(self) -> None:
        """Let nobody in any more."""
        self._shut.set()

    def require_open(self) -> None:
        """Raise UnavailableError when the server drains."""
        if self._shut.is_set():
            raise UnavailableError("fusion server: draining; try again in a moment")

    async def admit(self, requests: AsyncIterator[_Message]) -> AsyncIterator[_Message]:
        """The requests of a stream for as long as the door is open; then UnavailableError, even to a silent client."""
        shutting = asyncio.ensure_future(self._shut.wait())
        try:
            while True:
                self.require_open()
                reading = asyncio.ensure_future(_next(requests))
                await asyncio.wait([reading, shutting], return_when=asyncio.FIRST_COMPLETED)
                if not reading.done():
                    reading.cancel()
                    await asyncio.wait([reading])
                    self.require_open()
                request = reading.result()
                if request is None:
                    return
                yield request
        finally:
            shutting.cancel()


async def _next(requests: AsyncIterator[_Message]) -> _Message | None:
    return await anext(requests, None)
