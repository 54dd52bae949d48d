"""Notice that the camera of a slow browser moves, so that the page can draw less until it rests."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

_REST_S = 2.0
"""A camera that has not moved for this long, and for twice the time between two slow reports, is at rest."""
_LONGEST_GAP_S = 5.0
"""Reports further apart belong to two motions."""
_SLOW_GAP_S = 0.15
_GAPS = 2


class MovingCameras:
    """Calls on_change(True) when the camera of a slow browser moves, and on_change(False) when all are at rest.

    A browser reports each camera position that it has drawn. It is slow if the reports of a motion are more than
    150 ms apart, and remains so until `forget`. Thread-safe.
    """

    def __init__(
        self, on_change: Callable[[bool], None], rest_s: float = _REST_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._on_change, self._rest_s, self._clock = on_change, rest_s, clock
        self._lock = threading.Lock()
        self._gaps_s: dict[int, deque[float]] = {}
        self._slow_gap_s: dict[int, float] = {}
        self._reported_s: dict[int, float] = {}
        self._moving_until_s: float | None = None

    def watch(self, client: Any) -> None:
        """Follow the camera of a viser client."""
        client.camera.on_update(lambda _: self.report(client.client_id))

    def report(self, client: int) -> None:
        """Take the report of a camera position."""
        with self._lock:
            now_s = self._clock()
            gap_s = now_s - self._reported_s.get(client, -float("inf"))
            self._reported_s[client] = now_s
            if client not in self._slow_gap_s and not self._is_slow(client, gap_s):
                return
            slow_gap_s = self._slow_gap_s.setdefault(client, min(gap_s, _LONGEST_GAP_S))
            starts = self._moving_until_s is None
            self._moving_until_s = now_s + max(self._rest_s, 2.0 * slow_gap_s)
        if starts:
            self._on_change(True)
            threading.Thread(target=self._wait_for_rest, daemon=True).start()

    def forget(self) -> None:
        """Forget which browsers are slow: what the page draws has changed."""
        with self._lock:
            self._slow_gap_s.clear()
            self._gaps_s.clear()

    def _is_slow(self, client: int, gap_s: float) -> bool:
        gaps_s = self._gaps_s.setdefault(client, deque(maxlen=_GAPS))
        if gap_s > _LONGEST_GAP_S:
            gaps_s.clear()
            return False
        gaps_s.append(gap_s)
        return len(gaps_s) == _GAPS and statistics.median(gaps_s) > _SLOW_GAP_S

    def _wait_for_rest(self) -> None:
        while True:
            with self._lock:
                rest_s = (self._moving_until_s or 0.0) - self._clock()
                if rest_s <= 0:
                    self._moving_until_s = None
                    break
            time.sleep(rest_s)
        self._on_change(False)
