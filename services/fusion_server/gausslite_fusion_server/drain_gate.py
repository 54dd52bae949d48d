"""Accept calls while the server is up, and end the open streams when it drains."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import TypeVar

from gausslite.domain.errors import UnavailableError

_Message = TypeVar("_Message")


class DrainGate:
    """Open until `close` is called. Use it on the event loop only."""

    def __init__(self) -> None:
        self._closed = asyncio.Event()

    @property
    def is_open(self) -> bool:
        """False after `close`."""
        return not self._closed.is_set()

    def close(self) -> None:
        """Refuse new calls and end the streams read through `admit`."""
        self._closed.set()

    def require_open(self) -> None:
        """Raise UnavailableError if the server drains."""
        if self._closed.is_set():
            raise UnavailableError("fusion server: draining; try again in a moment")

    async def admit(self, requests: AsyncIterator[_Message]) -> AsyncIterator[_Message]:
        """Yield the requests of a stream. Raises UnavailableError when the gate closes, even between two requests."""
        closing = asyncio.ensure_future(self._closed.wait())
        try:
            while True:
                self.require_open()
                reading = asyncio.ensure_future(_next(requests))
                # a call that is cancelled during the wait never reads an invalid request's error
                reading.add_done_callback(_retrieve_error)
                await asyncio.wait([reading, closing], return_when=asyncio.FIRST_COMPLETED)
                if not reading.done():
                    reading.cancel()
                    await asyncio.wait([reading])
                    self.require_open()
                request = reading.result()
                if request is None:
                    return
                yield request
        finally:
            closing.cancel()


async def _next(requests: AsyncIterator[_Message]) -> _Message | None:
    return await anext(requests, None)


def _retrieve_error(reading: asyncio.Future[_Message | None]) -> None:
    if not reading.cancelled():
        reading.exception()
