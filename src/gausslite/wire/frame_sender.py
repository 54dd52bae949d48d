"""Send a running robot's frames to an agent: never block the caller, reconnect, count what became of each frame."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.clients import AgentClient
from gausslite.wire.retry_delay import RetryDelay

_FIRST_RETRY_S = 0.5
_OUTCOMES = {
    pb.FRAME_OUTCOME_MAPPED: "mapped",
    pb.FRAME_OUTCOME_SKIPPED: "skipped",
    pb.FRAME_OUTCOME_DROPPED: "dropped",
    pb.FRAME_OUTCOME_REJECTED: "rejected",
}


@dataclass(frozen=True, slots=True)
class SentFrames:
    """Frames by outcome. dropped: by the agent. overflow: here, because the connection was too slow or missing.

    lost: sent, but the stream ended before their outcome arrived.
    """

    offered: int = 0
    sent: int = 0
    mapped: int = 0
    skipped: int = 0
    dropped: int = 0
    rejected: int = 0
    overflow: int = 0
    lost: int = 0


class FrameSender:
    """Owns a bounded queue and the thread that streams its frames. A full queue drops its oldest frame."""

    def __init__(self, client: AgentClient, queue_frames: int = 8, lossless: bool = False) -> None:
        self._client, self._queue_frames, self._lossless = client, queue_frames, lossless
        self._queue: deque[tuple[Frame, Lens | None]] = deque()
        self._changed = threading.Condition()
        self._closing, self._stopped = False, threading.Event()
        self._stream_number = 0
        self._counters, self._problem = SentFrames(), ""
        self._thread = threading.Thread(target=self._run, name="frame sender", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> SentFrames:
        """Frames by outcome so far."""
        return self._counters

    @property
    def problem(self) -> str:
        """Why the latest stream ended, or why a frame was rejected; empty after a frame that was mapped."""
        return self._problem

    def send(self, frame: Frame, lens: Lens | None) -> None:
        """Queue a frame; lens: distortion of its images."""
        with self._changed:
            if len(self._queue) >= self._queue_frames:
                self._queue.popleft()
                self._count("overflow")
            self._queue.append((frame, lens))
            self._count("offered")
            self._changed.notify_all()

    def close(self, timeout_s: float) -> bool:
        """Send the queued frames and stop; False if that takes longer. The stream then ends with the client's."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        finished = not self._thread.is_alive()
        with self._changed:
            self._queue.clear()
            self._changed.notify_all()
        self._stopped.set()
        return finished

    def _run(self) -> None:
        delay = RetryDelay(_FIRST_RETRY_S)
        while self._wait_for_frame():
            try:
                self._stream(delay)
            except GaussLiteError as error:
                self._problem = str(error)
                with self._changed:
                    # the iterator of the broken stream must not take frames of the next one
                    self._stream_number += 1
                    self._changed.notify_all()
                c = self._counters
                self._count("lost", c.sent - c.mapped - c.skipped - c.dropped - c.rejected - c.lost)
                if self._closing or self._stopped.wait(delay.after(error)):
                    return

    def _stream(self, delay: RetryDelay) -> None:
        with self._changed:
            lens = self._queue[0][1]
        for outcome in self._client.ingest(self._frames(self._stream_number, lens), self._lossless, lens):
            name = _OUTCOMES.get(outcome.outcome, "skipped")
            self._count(name)
            self._problem = f"frame {outcome.index} was rejected: {outcome.reason}" if name == "rejected" else ""
            delay.reset()

    def _frames(self, stream_number: int, lens: Lens | None) -> Iterator[Frame]:
        """Yield the queued frames of one stream, whose images have one lens, as they arrive."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closing or stream_number != self._stream_number)
                if stream_number != self._stream_number or not self._queue or self._queue[0][1] != lens:
                    return
                frame, _ = self._queue.popleft()
                self._count("sent")
            yield frame

    def _wait_for_frame(self) -> bool:
        """Wait for a frame; False when the sender is closed and has sent all of them."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closing)
            return bool(self._queue)

    def _count(self, name: str, number: int = 1) -> None:
        with self._changed:
            self._counters = replace(self._counters, **{name: getattr(self._counters, name) + number})
