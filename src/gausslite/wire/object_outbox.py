"""The agent's latest task and objects, until the fusion server has them."""

from __future__ import annotations

import logging
from threading import Lock

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import ObjectReport
from gausslite.wire.clients import FusionClient

_log = logging.getLogger(__name__)


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

    def send(self, client: FusionClient, session_id: str) -> int:
        """Send the report if the server does not have it; returns the bytes. Raises GaussLiteError.

        A rejected report is dropped, because the map does not depend on it.
        """
        report, sent_bytes = self.pending, 0
        if report is None:
            return 0
        try:
            sent_bytes = client.report_objects(session_id, report)
        except InvalidInputError as error:
            _log.warning("uplink: the report of objects is dropped: %s", error)
        with self._lock:
            self._sent = report
        return sent_bytes

    def mark_unsent(self) -> None:
        """Note that the server has lost the report."""
        with self._lock:
            self._sent = None
