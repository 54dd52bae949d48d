"""End a stream whose client has stopped reading, so that it does not hold memory for ever."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

READ_DEADLINE_S = 60.0
"""For one message of at most a megabyte: 17 kB/s."""


@contextmanager
def read_deadline(limit_s: float = READ_DEADLINE_S) -> Iterator[None]:
    """Cancel the current task, the call, if the block takes longer. Use it around the `yield` of one message."""
    task = asyncio.current_task()
    assert task is not None
    timer = asyncio.get_running_loop().call_later(limit_s, task.cancel, "the client has stopped reading")
    try:
        yield
    finally:
        timer.cancel()
