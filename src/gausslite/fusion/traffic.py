"""The figures of a mission and of its agents: messages, stored data, voxels won, and whether the store can write."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from threading import Lock
from typing import NamedTuple

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.limits import MissionConfig
from gausslite.fusion.store import FusionStore
from gausslite.fusion.update_log import PutOutcome

_PROBE_BYTES = 256 << 10
# no agent can have an empty id
_PROBE = "", "storage-probe"
ACKNOWLEDGEMENT_BOUNDS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_LONGEST_WAIT_S = 5.0


class StorageProbe:
    """Writes and deletes a record of the size of a large message. Thread-safe."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self.is_writable = True
        """The result of the latest check."""

    def check(self) -> None:
        """Raise StorageError if the store does not take 256 KiB."""
        try:
            self._store.save_record(*_PROBE, bytes(_PROBE_BYTES))
            # its pages are free again, so that the next check needs new ones if messages have taken them
            self._store.save_record(*_PROBE, b"")
        except StorageError:
            self.is_writable = False
            raise
        self.is_writable = True


class Acknowledgements:
    """The times from the arrival of a message to its answer. Thread-safe. clock_s: the time in seconds.

    An agent waits since the arrival of its first message without an answer, or since its last answer: how many messages
    it has sent ahead says nothing about the server.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._lock = Lock()
        # of each agent that waits: the number of its messages, and since when
        self._waiting: dict[str, tuple[int, float]] = {}
        self._prompt_s = -float("inf")
        self._counts = [0] * (len(ACKNOWLEDGEMENT_BOUNDS_S) + 1)
        self._total_s = 0.0

    def add(self, agent_id: str, put: Future[PutOutcome]) -> None:
        """Note a message of an agent that has arrived; its future ends with the answer."""
        now_s = self._clock_s()
        with self._lock:
            count, since_s = self._waiting.get(agent_id, (0, now_s))
            self._waiting[agent_id] = count + 1, since_s
        put.add_done_callback(lambda _: self._end(agent_id, now_s))

    def check(self) -> None:
        """Raise UnavailableError while an agent waits for more than 5 s, and in that time none was answered sooner.

        Others' answers show that the server works, and that this agent has sent more than its share.
        """
        with self._lock:
            now_s, prompt_s = self._clock_s(), self._prompt_s
            messages = sum(count for count, _ in self._waiting.values())
            name, since_s = min(
                ((name, since_s) for name, (_, since_s) in self._waiting.items()),
                key=lambda waiting: waiting[1],
                default=("", now_s),
            )
        if now_s - max(since_s, prompt_s) > _LONGEST_WAIT_S:
            raise UnavailableError(
                f"{messages} messages wait for their acknowledgement, agent {quote_name(name)} for "
                f"{now_s - since_s:.0f} s; expected at most {_LONGEST_WAIT_S:g} s"
            )

    def histogram(self) -> tuple[tuple[int, ...], float]:
        """Return the number of answers up to each of ACKNOWLEDGEMENT_BOUNDS_S and beyond, and the sum of the times."""
        with self._lock:
            return tuple(self._counts), self._total_s

    def _end(self, agent_id: str, arrived_s: float) -> None:
        with self._lock:
            now_s = self._clock_s()
            count, since_s = self._waiting.pop(agent_id)
            if count > 1:
                self._waiting[agent_id] = count - 1, now_s
            if now_s - since_s <= _LONGEST_WAIT_S:
                self._prompt_s = now_s
            taken_s = now_s - arrived_s
            self._counts[bisect_left(ACKNOWLEDGEMENT_BOUNDS_S, taken_s)] += 1
            self._total_s += taken_s


class TrafficCounters(NamedTuple):
    """Messages of one agent."""

    last_seen_ns: int = 0  # time of its latest subset or sign of life, 0 before
    localisation: int = 0  # of the robot, as its agent said last: a number of the protocol, 0 before
    roi_bytes: int = 0  # of the region's voxels, while the mission runs
    handover_bytes: int = 0  # of the rest of the map, after it
    subsets_accepted: int = 0
    subsets_stale: int = 0  # without a voxel that was new
    subsets_rejected: int = 0

    def plus(self, newer: TrafficCounters) -> TrafficCounters:
        """Return the sums, with last_seen_ns of the newer counters, and its localisation if it states one."""
        counts = zip(self[2:], newer[2:], strict=True)
        localisation = newer.localisation or self.localisation
        return TrafficCounters(newer.last_seen_ns, localisation, *(own + more for own, more in counts))


class TrafficLog:
    """The counters of each agent since the start of the server. Thread-safe: counting waits for no commit."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._by_agent: dict[str, TrafficCounters] = {}

    def record(self, agent_id: str, traffic: TrafficCounters) -> None:
        """Add to the agent's counters, and set its last_seen_ns to now."""
        with self._lock:
            self._by_agent[agent_id] = self.of(agent_id).plus(traffic._replace(last_seen_ns=time.time_ns()))

    def of(self, agent_id: str) -> TrafficCounters:
        """Return the agent's counters; zero for an unknown agent."""
        return self._by_agent.get(agent_id, TrafficCounters())

    def remove_agent(self, agent_id: str) -> None:
        """Delete the counters of the agent."""
        with self._lock:
            self._by_agent.pop(agent_id, None)


@dataclass(frozen=True, slots=True)
class AgentContribution:
    """Stored data of one agent, the number of voxels that it wins, its task's targets, its frame and its traffic."""

    agent_id: str
    joined: bool = False  # a session is open
    voxels: int = 0
    gaussians: int = 0
    kappa_sum: int = 0  # over its voxels
    won_voxels: int = 0  # where the vote chose it
    last_update_seq: int = 0
    keyframes: int = 0
    targets: tuple[str, ...] = ()
    alignment: FrameAlignment = field(default_factory=lambda: FrameAlignment(0))
    traffic: TrafficCounters = field(default_factory=TrafficCounters)


@dataclass(frozen=True, slots=True)
class MissionStatus:
    """The figures of a mission and of each agent."""

    mission_config: MissionConfig
    revision: int  # of the fused map
    fused_gaussians: int
    fused_voxels: int
    keyframes: int
    refined: bool  # a refined map is there
    agents: tuple[AgentContribution, ...]
    banned_agents: tuple[str, ...] = ()  # may not contribute
