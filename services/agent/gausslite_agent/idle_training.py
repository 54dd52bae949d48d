"""Train on earlier keyframes while no frame waits, one iteration at a time."""

from __future__ import annotations

import logging
from collections.abc import Callable

_log = logging.getLogger(__name__)


class IdleTraining:
    """Schedules idle iterations after each frame, up to a limit. All methods run on the mapping worker."""

    def __init__(
        self,
        iterations_per_frame: int,
        step: Callable[[], bool],
        publish_changes: Callable[[], None],
        frame_waits: Callable[[], bool],
        schedule: Callable[[Callable[[], None]], None],
    ) -> None:
        """Step trains one iteration and returns False if it cannot; schedule queues a function on the worker."""
        self._iterations_per_frame = iterations_per_frame
        self._step = step
        self._publish_changes = publish_changes
        self._frame_waits = frame_waits
        self._schedule = schedule
        self._remaining = 0
        self._scheduled = False
        self._has_unpublished = False

    def start(self) -> None:
        """Allow the iterations of one frame, and run the first."""
        self._remaining = self._iterations_per_frame
        if not self._scheduled and self._remaining > 0:
            self._run_one()

    def mark_published(self) -> None:
        """Record that the changes of all iterations so far are published."""
        self._has_unpublished = False

    def stop(self) -> None:
        """End the iterations until the next frame, and publish their changes."""
        self._remaining, self._scheduled = 0, False
        if self._has_unpublished:
            self._has_unpublished = False
            self._publish_changes()

    def _run_one(self) -> None:
        """Run one iteration if no frame waits, and schedule the next behind all queued work.

        An error is logged, because no caller waits for the result, and ends the iterations until the next frame.
        """
        self._scheduled = not self._frame_waits()
        if not self._scheduled:
            return
        try:
            if self._remaining == 0 or not self._step():
                self.stop()
                return
            self._remaining -= 1
            self._has_unpublished = True
            self._schedule(self._run_one)
        except Exception:
            _log.exception("an idle iteration failed; idle training continues after the next frame")
            self._remaining, self._scheduled = 0, False
