"""What a running robot's program needs of its agent: send frames, assign tasks, follow the status, end the mission.

No call blocks, except `close`: two threads talk to the agent, one with frames, one with tasks and queries.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from gausslite.domain.errors import GaussLiteError, UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.wire.agent_snapshot import AgentSnapshot
from gausslite.wire.clients import AgentClient
from gausslite.wire.frame_sender import FrameSender, SentFrames

_CLOSE_S = 10.0


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """poll_s: time between status queries. lossless: colour as PNG in place of JPEG.

    handover: also send the map outside the region when the mission ends. drain_s: longest time to send then. None: as
    the agent's options.
    """

    poll_s: float = 1.0
    queue_frames: int = 8
    lossless: bool = False
    handover: bool | None = None
    drain_s: float | None = None


class AgentLink:
    """Owns the threads; the client stays the caller's until `close`, which closes it."""

    def __init__(self, client: AgentClient, settings: LinkSettings | None = None) -> None:
        self._client, self._settings = client, settings or LinkSettings()
        self._sender = FrameSender(client, self._settings.queue_frames, self._settings.lossless)
        self._task: str | None = None
        self._task_problem = self._status_problem = ""
        self._snapshot: AgentSnapshot | None = None
        self._closing = self._woken = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="agent link", daemon=True)
        self._thread.start()

    @property
    def snapshot(self) -> AgentSnapshot | None:
        """The agent's latest status; None before the first and while the agent does not answer."""
        return self._snapshot

    @property
    def sent_frames(self) -> SentFrames:
        """Frames by outcome so far."""
        return self._sender.counters

    @property
    def problems(self) -> tuple[str, ...]:
        """What does not work now: the connection, the latest task, the latest frames."""
        found = (self._status_problem, self._task_problem, self._sender.problem)
        # without a connection, all three say so
        return tuple(dict.fromkeys(filter(None, found)))

    def send(self, frame: Frame, lens: Lens | None) -> None:
        """Queue a frame; lens: distortion of its images. The oldest waiting frame is dropped if the queue is full."""
        self._sender.send(frame, lens)

    def assign_task(self, text: str) -> None:
        """Assign a task soon; a later task replaces one that waits. It is repeated until the agent can be reached."""
        with self._changed:
            self._task, self._woken = text, True
            self._changed.notify_all()

    def close(self, end_mission: bool = True) -> str:
        """Send the waiting frames, end the mission if requested, close the client; return the mission's summary.

        The summary is empty without end_mission, and for an agent that has had no task. Raises GaussLiteError if the
        mission could not be ended.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        try:
            self._sender.close(_CLOSE_S)
            if not end_mission or self._waits_for_task():
                return ""
            return self._client.end_mission(self._settings.handover, self._settings.drain_s).summary
        finally:
            self._client.close()
            self._thread.join(_CLOSE_S)

    def _waits_for_task(self) -> bool:
        return self._snapshot is not None and self._snapshot.state == "waiting_for_task"

    def _run(self) -> None:
        while True:
            self._assign_waiting_task()
            self._query_status()
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._woken, self._settings.poll_s)
                self._woken = False
                if self._closing:
                    return

    def _assign_waiting_task(self) -> None:
        task = self._task
        if task is None:
            return
        try:
            self._client.assign_task(task)
            self._task_problem = ""
        except UnavailableError as error:
            self._task_problem = str(error)
            return
        except GaussLiteError as error:
            self._task_problem = f"task: {error}"
        with self._changed:
            if self._task == task:
                self._task = None

    def _query_status(self) -> None:
        try:
            self._snapshot = AgentSnapshot.from_message(self._client.status())
            self._status_problem = ""
        except GaussLiteError as error:
            self._snapshot, self._status_problem = None, str(error)
