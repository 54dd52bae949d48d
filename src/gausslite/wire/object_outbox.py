"""The agent's latest task and objects, until the fusion server has them."""

from __future__ import annotations

from threading import Lock

from gausslite.domain.objects import ObjectReport


class ObjectOutbox:
    """Holds one report; a newer one replaces it. Thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._latest: ObjectReport | None = None
        self._sent: ObjectReport | None = None

    def put(self, report: ObjectReport) -> bool:
        """Replace the report; returns whether it has to be sent."""
        with self._lock:
            self._latest = report
            return self._latest != self._sent

    @property
    def latest(self) -> ObjectReport | None:
        """The latest report, sent or not."""
        return self._latest

    @property
    def pending(self) -> ObjectReport | None:
        """The latest report if the server does not have it."""
        with self._lock:
            return None if self._latest == self._sent else self._latest

    def mark_done(self, report: ObjectReport) -> None:
        """Note that the server has this report, or has rejected it."""
        with self._lock:
            self._sent = report

    def mark_unsent(self) -> None:
        """Note that the server has lost the report."""
        with self._lock:
            self._sent = None
