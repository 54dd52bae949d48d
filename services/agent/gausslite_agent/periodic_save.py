"""Save a running mission from time to time, so that a process that is killed loses little."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from gausslite.domain.errors import GaussLiteError

_log = logging.getLogger(__name__)
_MIN_INTERVAL_PER_SAVE = 20.0
"""Saving takes at most a twentieth of the time."""


class PeriodicSave:
    """A context that calls `save` on a thread of its own; with an interval of 0 it does nothing."""

    def __init__(self, save: Callable[[], float], interval_s: float) -> None:
        """`save` returns the seconds that it took. interval_s: between two saves; slow ones are rarer."""
        self._save, self._interval_s = save, interval_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="periodic save", daemon=True)

    def __enter__(self) -> PeriodicSave:
        if self._interval_s > 0:
            self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """End the thread without waiting for a save that has begun; the mission's own save follows it."""
        self._ended.set()

    def _run(self) -> None:
        wait_s, failed = self._interval_s, False
        while not self._ended.wait(wait_s):
            wait_s = self._interval_s
            try:
                wait_s = max(wait_s, _MIN_INTERVAL_PER_SAVE * self._save())
                failed = False
            except GaussLiteError as error:
                if not failed:
                    _log.warning("the mission is not saved: %s", error)
                failed = True
