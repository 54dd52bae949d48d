"""A bounded queue of frames that drops one frame if it is full."""

from __future__ import annotations

import threading
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field

from gausslite.domain.frame import Frame
from gausslite_agent.load import QueuePolicy
from gausslite_agent.status import FrameReport


def _running_future() -> Future[FrameReport]:
    """Return a future that its receiver cannot cancel."""
    future: Future[FrameReport] = Future()
    future.set_running_or_notify_cancel()
    return future


@dataclass(frozen=True, slots=True, eq=False)
class QueuedFrame:
    """A frame, the time of its arrival, and the future of its report."""

    frame: Frame
    arrival_s: float
    report: Future[FrameReport] = field(default_factory=_running_future)


class FrameQueue:
    """Frames in order of arrival. Thread-safe."""

    def __init__(self, max_frames: int, policy: QueuePolicy) -> None:
        self._max_frames = max_frames
        self._policy = policy
        self._frames: deque[QueuedFrame] = deque()
        self._lock = threading.Lock()

    def put(self, frame: QueuedFrame) -> QueuedFrame | None:
        """Add a frame. Return the frame that is dropped if the queue was full."""
        with self._lock:
            self._frames.append(frame)
            if len(self._frames) <= self._max_frames:
                return None
            return self._frames.popleft() if self._policy is QueuePolicy.OLDEST else self._frames.pop()

    def get(self) -> QueuedFrame | None:
        """Remove and return the oldest frame; None if the queue is empty."""
        with self._lock:
            return self._frames.popleft() if self._frames else None

    @property
    def is_empty(self) -> bool:
        """True if no frame waits."""
        with self._lock:
            return not self._frames
