"""Compute in a thread what a reader who walks through a sequence requests next."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import Generic, TypeVar

_LARGEST_STEP = 10
_Item = TypeVar("_Item")


class ReadAhead(Generic[_Item]):
    """Items 0 to count - 1, each computed for one request. After two requests in order, one item is computed ahead.

    The next item lies the smaller of the last two steps ahead: a reader may leave out some. Thread-safe.
    """

    def __init__(self, compute: Callable[[int], _Item], count: int) -> None:
        self._compute, self._count = compute, count
        self._lock, self._pool = threading.Lock(), ThreadPoolExecutor(1, "read-ahead")
        self._requested = deque[int](maxlen=3)
        self._ahead: tuple[int, Future[_Item]] | None = None

    def __call__(self, i: int) -> _Item:
        """Return item i. Raises what its computation raises."""
        with self._lock:
            found = self._ahead if self._ahead and self._ahead[0] == i else None
            if self._ahead and found is None:
                self._ahead[1].cancel()
            self._requested.append(i)
            following = self._next()
            # the thread begins it after the item that is found
            self._ahead = None if following is None else (following, self._pool.submit(self._compute, following))
        return found[1].result() if found else self._compute(i)

    def _next(self) -> int | None:
        requested = list(self._requested)
        steps = [after - before for before, after in pairwise(requested)]
        following = requested[-1] + min(steps, default=0)
        in_order = steps and 0 < min(steps) <= _LARGEST_STEP
        return following if in_order and following < self._count else None
