"""Run the expensive work of calls in a few threads, in fair turns between their callers; too much is refused."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from gausslite.domain.errors import RateLimitError
from gausslite.wire.security import caller_or_connection

_Result = TypeVar("_Result")
_RETRY_AFTER_S, _REFUSAL_PAUSE_S = 1.0, 0.5
_LONG_S, _MAX_KNOWN = 0.05, 1000
_TYPICAL_SHARE = 0.25  # of the latest call in the mean of all


class WorkerPool:
    """Threads for one kind of work, and who waits for them. Use it on the event loop.

    The next turn is that of the caller who will have used least time since it came when its call ends (self-clocked
    fair queueing, Golestani 1994; a call is taken to last as its caller's last one): who floods waits behind its own
    calls, also with several connections. If too many wait, the newest of the caller with most of them is refused.
    """

    def __init__(self, name: str, threads: int = 1, waiting: int = 64, pause: float = 0.0) -> None:
        """waiting: most calls that wait. pause: after long work, in its durations, so that others have the disk."""
        self._name, self._limit, self._pause = name, waiting, pause
        self._executor = ThreadPoolExecutor(threads, name)
        self._free = threads
        # in the order of arrival
        self._waiting: dict[asyncio.Future[None], str] = {}
        self._running: Counter[str] = Counter()
        self._used_s: dict[str, float] = {}
        # of each caller's last call, and of all calls for a caller who has had none
        self._last_s: dict[str, float] = {}
        self._typical_s = 0.0
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
        self._used_s[caller] = max(self._used_s.get(caller, 0.0), self._now_s)
        turn = asyncio.get_running_loop().create_future()
        self._waiting[turn] = caller
        self._start_next()
        if len(self._waiting) > self._limit:
            self._refuse()
        try:
            await turn
        except asyncio.CancelledError:
            # its call has ended, while it waited or just after its turn had begun
            self._waiting.pop(turn, None)
            if not turn.cancelled() and turn.exception() is None:
                self._end(caller, time.monotonic())
            raise

    def _refuse(self) -> None:
        waiting = Counter(self._waiting.values())
        turn = max(reversed(self._waiting), key=lambda turn: waiting[self._waiting[turn]])
        message = (
            f"{self._name}: expected at most {self._limit} calls that wait, got more, most of them from "
            f"{self._waiting.pop(turn)[:200]}; call again later"
        )

        def answer() -> None:
            if not turn.cancelled():
                turn.set_exception(RateLimitError(message, retry_after_s=_RETRY_AFTER_S))

        # not at once: who calls again without a pause would keep the event loop busy with refusals
        asyncio.get_running_loop().call_later(_REFUSAL_PAUSE_S, answer)

    def _start_next(self) -> None:
        while self._free and self._waiting:
            turn = min(self._waiting, key=lambda turn: self._rank(self._waiting[turn]))
            caller = self._waiting.pop(turn)
            if turn.cancelled():
                continue
            self._free -= 1
            self._running[caller] += 1
            self._now_s = max(self._now_s, self._used_s[caller])
            turn.set_result(None)

    def _rank(self, caller: str) -> tuple[int, float]:
        return self._running[caller], self._used_s[caller] + self._last_s.get(caller, self._typical_s)

    def _end(self, caller: str, begin_s: float) -> None:
        took_s = time.monotonic() - begin_s
        self._used_s[caller] += took_s
        self._last_s[caller] = took_s
        self._typical_s += _TYPICAL_SHARE * (took_s - self._typical_s)
        self._running -= Counter([caller])
        if not self._running and not self._waiting:
            # after an idle time nobody is behind
            self._now_s = max(self._used_s.values())
        if len(self._used_s) > _MAX_KNOWN:
            active = {*self._running, *self._waiting.values()}
            self._used_s, self._last_s = (
                {other: value for other, value in of.items() if other in active} for of in (self._used_s, self._last_s)
            )
        asyncio.get_running_loop().call_later(self._pause * took_s if took_s > _LONG_S else 0.0, self._free_one)

    def _free_one(self) -> None:
        self._free += 1
        self._start_next()
