"""Wait for the parser service to start, until the agent is stopped."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from gausslite.domain.errors import UnavailableError
from gausslite.domain.task import TaskGraph
from gausslite.task.parser import TaskParser

_log = logging.getLogger(__name__)
_TIMEOUT_S = 30.0
_RETRY_S = 0.5


class WaitingParser:
    """A TaskParser that retries while its service is unavailable, up to 30 seconds."""

    def __init__(
        self, parser: TaskParser, timeout_s: float = _TIMEOUT_S, cancel: Callable[[], None] = lambda: None
    ) -> None:
        """cancel: ends the parser's open calls with UnavailableError; a service may accept a call and not answer."""
        self._parser = parser
        self._timeout_s = timeout_s
        self._cancel = cancel
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End the wait: an open call is cancelled, and `parse` raises UnavailableError with the last error before."""
        self._stopping.set()
        self._cancel()

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of a task. Raises TaskError; UnavailableError after the timeout or `stop`."""
        deadline_s = time.monotonic() + self._timeout_s
        last_error: UnavailableError | None = None
        while True:
            try:
                return self._parser.parse(text)
            except UnavailableError as error:
                if not self._stopping.is_set():
                    if time.monotonic() >= deadline_s:
                        raise
                    if last_error is None:
                        _log.warning("%s; retrying for %.0f s", error, self._timeout_s)
                    last_error = error
                # the error of a call that `stop` cancels says nothing about the service
                if self._stopping.wait(_RETRY_S):
                    waited = "stopped while waiting for the parser service"
                    raise UnavailableError(waited if last_error is None else f"{waited}: {last_error}") from None
