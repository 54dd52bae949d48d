"""What a running robot's program needs of its agent: send frames, assign tasks, follow the status, end the mission.

No call blocks, except `close`: two threads talk to the agent, one with frames, one with tasks and queries.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import GaussLiteError, InvalidInputError, UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.objects import MAX_OBJECTS_PER_AGENT, ObjectLandmark
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.v1.geometry_pb2 import Localisation
from gausslite.wire.channel import RetryDelay
from gausslite.wire.clients import AgentClient
from gausslite.wire.convert import transform_from_message, values_of
from gausslite.wire.convert_task import object_from_message
from gausslite_link.map_follower import FollowedMap, MapFollower

_STATES = {number: name.removeprefix("AGENT_STATE_").lower() for name, number in pb.AgentState.items()}
_LOCALISATIONS = {number: name.removeprefix("LOCALISATION_").lower() for name, number in Localisation.items()}
_FRAMES = tuple(f"frames_{outcome}" for outcome in ("mapped", "skipped", "dropped", "rejected"))
_FIGURES = ("agent_id", "gaussians", *_FRAMES, "hz", "roi_share")


@dataclass(frozen=True, slots=True, eq=False)
class AgentSnapshot:
    """state: "mapping", "draining", "ended" ... as in AgentState. T_map_odometry: None before the first mapped frame.
    localisation: "tracked", "doubtful" or "lost".

    problem: why the agent's uplink stopped for good; empty while it runs.
    """

    agent_id: str
    state: str
    task: str
    gaussians: int
    frames_mapped: int
    frames_skipped: int
    frames_dropped: int
    frames_rejected: int
    hz: float
    roi_share: float
    age_p50_s: float
    problem: str
    notes: tuple[str, ...]
    T_map_odometry: Float64[ndarray, "4 4"] | None
    localisation: str
    objects: tuple[ObjectLandmark, ...]

    @classmethod
    def from_message(cls, message: pb.GetAgentStatusResponse) -> AgentSnapshot:
        """Decode a status. Raises InvalidInputError, PoseError."""
        if len(message.objects) > MAX_OBJECTS_PER_AGENT:
            raise InvalidInputError(f"objects: expected at most {MAX_OBJECTS_PER_AGENT}, got {len(message.objects)}")
        T_map_odometry = None
        if message.HasField("map_to_odom"):
            T_map_odometry = transform_from_message("t_map_odometry", message.map_to_odom.t_map_odometry)
        return cls(
            **values_of(message, _FIGURES),
            state=_STATES.get(message.state, "unknown"),
            task=message.graph.text,
            age_p50_s=message.age_p50_seconds,
            problem=message.uplink.stopped_because,
            notes=tuple(message.notes),
            T_map_odometry=T_map_odometry,
            localisation=_LOCALISATIONS.get(message.localisation, "unknown"),
            objects=tuple(object_from_message(landmark) for landmark in message.objects),
        )


_FIRST_RETRY_S = 0.5
_OUTCOMES = {number: name.removeprefix("FRAME_OUTCOME_").lower() for name, number in pb.FrameOutcome.items() if number}


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
        self.counters = SentFrames()
        """Frames by outcome so far."""
        self.problem = ""
        """Why the latest stream ended, or why a frame was rejected; empty after a frame that was mapped."""
        self._thread = threading.Thread(target=self._run, name="frame sender", daemon=True)
        self._thread.start()

    def send(self, frame: Frame, lens: Lens | None) -> None:
        """Queue a frame; lens: distortion of its images."""
        with self._changed:
            if len(self._queue) >= self._queue_frames:
                self._queue.popleft()
                self._count("overflow")
            self._queue.append((frame, lens))
            self._count("offered")
            self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """Send the queued frames and stop. What takes longer is dropped, and the stream ends with the client's."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        with self._changed:
            self._queue.clear()
            self._changed.notify_all()
        self._stopped.set()

    def _run(self) -> None:
        delay = RetryDelay(_FIRST_RETRY_S)
        while self._wait_for_frame():
            try:
                self._stream(delay)
            except GaussLiteError as error:
                self.problem = str(error)
                with self._changed:
                    # the iterator of the broken stream must not take frames of the next one
                    self._stream_number += 1
                    self._changed.notify_all()
                c = self.counters
                self._count("lost", c.sent - c.mapped - c.skipped - c.dropped - c.rejected - c.lost)
                if self._closing or self._stopped.wait(delay.after(error)):
                    return

    def _stream(self, delay: RetryDelay) -> None:
        with self._changed:
            lens = self._queue[0][1]
        for outcome in self._client.ingest(self._frames(self._stream_number, lens), self._lossless, lens):
            name = _OUTCOMES.get(outcome.outcome, "skipped")
            self._count(name)
            self.problem = f"frame {outcome.index} was rejected: {outcome.reason}" if name == "rejected" else ""
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
            self.counters = replace(self.counters, **{name: getattr(self.counters, name) + number})


_CLOSE_S = 10.0


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """poll_s: time between status queries. lossless: colour as PNG in place of JPEG.

    handover: also send the map outside the region when the mission ends. drain_s: longest time to send then. None: as
    the agent's options. follow_map: read the agent's map while it grows.
    """

    poll_s: float = 1.0
    queue_frames: int = 8
    lossless: bool = False
    handover: bool | None = None
    drain_s: float | None = None
    follow_map: bool = False


class AgentLink:
    """Owns the threads; the client stays the caller's until `close`, which closes it."""

    def __init__(self, client: AgentClient, settings: LinkSettings | None = None) -> None:
        self._client, self._settings = client, settings or LinkSettings()
        self._sender = FrameSender(client, self._settings.queue_frames, self._settings.lossless)
        self._task: str | None = None
        self._task_problem = self._status_problem = ""
        self.snapshot: AgentSnapshot | None = None
        """The agent's latest status; None before the first and while the agent does not answer."""
        self._closing = self._woken = False
        self._changed = threading.Condition()
        self._follower = MapFollower(client.watch_map) if self._settings.follow_map else None
        self._thread = threading.Thread(target=self._run, name="agent link", daemon=True)
        self._thread.start()

    @property
    def sent_frames(self) -> SentFrames:
        """Frames by outcome so far."""
        return self._sender.counters

    def map(self) -> FollowedMap | None:
        """Return the agent's map; None before the first revision and without `follow_map`."""
        return None if self._follower is None else self._follower.newest()

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
            waits_for_task = self.snapshot is not None and self.snapshot.state == "waiting_for_task"
            if not end_mission or waits_for_task:
                return ""
            return self._client.end_mission(self._settings.handover, self._settings.drain_s).summary
        finally:
            self._client.close()
            if self._follower is not None:
                self._follower.close()
            self._thread.join(_CLOSE_S)

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
            self.snapshot = AgentSnapshot.from_message(self._client.status())
            self._status_problem = ""
        except GaussLiteError as error:
            self.snapshot, self._status_problem = None, str(error)
