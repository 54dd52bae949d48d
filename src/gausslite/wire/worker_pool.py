"""Run the expensive work of calls in a few threads, in fair turns between their callers; too much is refused."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from gausslite.domain.errors import RateLimitError
from gausslite.wire.security import caller_or_connection

_Result = TypeVar("_Result")
_RETRY_AFTER_S = 1.0
_LONG_S = 0.05
_MAX_KNOWN = 1000


class WorkerPool:
    """Threads for one kind of work, and who waits for them. Use it on the event loop.

    The next turn is that of the caller whose calls have used least time since it came (start-time fair queueing, Goyal
    1996): who floods waits behind its own calls, also with several connections. If too many wait, the newest call of
    the caller with most of them is refused.
    """

    def __init__(self, name: str, threads: int = 1, waiting: int = 64, pause: float = 0.0) -> None:
        """waiting: most calls that wait. pause: after long work, in its durations, so that others have the disk."""
        self._name, self._limit, self._pause = name, waiting, pause
        self._executor = ThreadPoolExecutor(threads, name)
        self._free = threads
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._running: Counter[str] = Counter()
        self._used_s: dict[str, float] = {}
        # the used time of the latest turn: who comes now begins with it, so that waiting does not collect turns
        self._now_s = 0.0

    async def run(self, context: Any, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Return what the function returns in a thread, in the turn of a call's caller. Raises RateLimitError."""
        caller = caller_or_connection(context)
        await self._begin(caller)
        ended = functools.partial(self._end, caller, time.monotonic())
        loop = asyncio.get_running_loop()

        def free(_: Future[_Result]) -> None:
            # the loop may have ended before the thread
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(ended)

        try:
            work = self._executor.submit(function, *arguments)
        except RuntimeError:
            ended()
            raise
        # not when the call ends: its thread still works
        work.add_done_callback(free)
        return await asyncio.wrap_future(work)

    def close(self) -> None:
        """Wait until the threads have ended their work."""
        self._executor.shutdown(wait=True, cancel_futures=True)

    async def _begin(self, caller: str) -> None:
        self._used_s[caller] = max(self._used_s.pop(caller, 0.0), self._now_s)
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(caller, deque()).append(turn)
        self._start_next()
        if sum(map(len, self._waiting.values())) > self._limit:
            self._refuse(max(reversed(self._waiting), key=lambda other: len(self._waiting[other])))
        try:
            await turn
        except asyncio.CancelledError:
            # its call has ended, while it waited or just after its turn had begun
            if turn.cancelled():
                self._remove(caller, turn)
            elif turn.exception() is None:
                self._end(caller, time.monotonic())
            raise

    def _refuse(self, caller: str) -> None:
        turn = self._waiting[caller][-1]
        self._remove(caller, turn)
        turn.set_exception(
            RateLimitError(
                f"{self._name}: expected at most {self._limit} calls that wait, got more, most of them from "
                f"{caller[:200]}; call again later",
                retry_after_s=_RETRY_AFTER_S,
            )
        )

    def _remove(self, caller: str, turn: asyncio.Future[None]) -> None:
        own = self._waiting.get(caller, deque())
        if turn in own:
            own.remove(turn)
        if not own:
            self._waiting.pop(caller, None)

    def _start_next(self) -> None:
        while self._free and self._waiting:
            caller = min(self._waiting, key=lambda other: (self._running[other], self._used_s[other]))
            turn = self._waiting[caller][0]
            self._remove(caller, turn)
            if turn.done():
                continue
            self._free -= 1
            self._running[caller] += 1
            self._now_s = max(self._now_s, self._used_s[caller])
            turn.set_result(None)

    def _end(self, caller: str, begin_s: float) -> None:
        took_s = time.monotonic() - begin_s
        self._used_s[caller] += took_s
        self._running -= Counter([caller])
        for other in list(self._used_s)[: max(0, len(self._used_s) - _MAX_KNOWN)]:
            if other not in self._waiting and other not in self._running:
                del self._used_s[other]
        asyncio.get_running_loop().call_later(self._pause * took_s if took_s > _LONG_S else 0.0, self._free_one)

    def _free_one(self) -> None:
        self._free += 1
        self._start_next()
