"""Queue the agents' updates for the committing thread, fairly: each agent gets an equal share of the voxels stored."""

from __future__ import annotations

import heapq
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from threading import Lock

import numpy as np

from gausslite.domain.errors import UnavailableError
from gausslite.domain.names import quote_name
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import slice_voxels
from gausslite.fusion.store_values import PutOutcome

SLICE_VOXELS = 2048
"""A larger message is stored in parts of this size, so that it does not delay the other agents."""
_MESSAGE_COST = 16
"""The cost of a message beside its voxels, in voxels."""
_MAX_PENDING = 64
"""Of one agent; a robot waits for each acknowledgement, so it has one or two."""


@dataclass(slots=True, eq=False)
class PendingUpdate:
    """A message that waits for its commit. It is stored in slices; `outcomes` has those of the stored slices."""

    session_id: str
    subset: RoiSubset
    future: Future[PutOutcome] = field(default_factory=Future)
    next_voxel: int = 0
    outcomes: list[PutOutcome] = field(default_factory=list)

    def __post_init__(self) -> None:
        # a client that disconnects cannot cancel it any more: the message is stored in any case
        self.future.set_running_or_notify_cancel()

    def next_slice(self) -> RoiSubset:
        """Return the part of the message to store next."""
        subset, start = self.subset, self.next_voxel
        if len(subset.batch) <= SLICE_VOXELS:
            return subset
        part = slice_voxels(subset.batch, start, start + SLICE_VOXELS)
        return RoiSubset(subset.agent_id, subset.session_id, subset.message_seq, subset.update_seq, part)

    def add_outcome(self, outcome: PutOutcome) -> bool:
        """Note that the next slice is stored; returns whether it was the last one."""
        self.outcomes.append(outcome)
        self.next_voxel += SLICE_VOXELS
        return self.next_voxel >= len(self.subset.batch)

    def outcome(self) -> PutOutcome:
        """Return the outcome of the whole message."""
        return PutOutcome(
            np.concatenate([each.accepted for each in self.outcomes]),
            np.concatenate([each.stale for each in self.outcomes]),
        )


class UpdateQueue:
    """Start-time fair queueing over the agents, by voxels. Thread-safe.

    Source: P. Goyal et al., "Start-time fair queueing", IEEE/ACM Transactions on Networking 5(5), 1997.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._pending: dict[str, deque[PendingUpdate]] = {}
        # (virtual start time, order of arrival, agent id) of each agent with pending messages
        self._waiting: list[tuple[float, int, str]] = []
        self._finish: dict[str, float] = {}
        self._now = 0.0
        self._arrivals = 0

    def add(self, update: PendingUpdate) -> None:
        """Queue a message. Raises UnavailableError if its agent has too many."""
        agent_id = update.subset.agent_id
        with self._lock:
            own = self._pending.setdefault(agent_id, deque())
            if len(own) >= _MAX_PENDING:
                raise UnavailableError(
                    f"agent {quote_name(agent_id)}: expected at most {_MAX_PENDING} messages that wait for their "
                    "acknowledgement; wait for some"
                )
            own.append(update)
            if len(own) == 1:
                self._wait(agent_id)

    @property
    def has_waiting(self) -> bool:
        """Whether `take` would return a message."""
        return bool(self._waiting)

    def take(self, max_voxels: int) -> list[PendingUpdate]:
        """Return the first message of the agents whose turn it is, at least one if any wait; they stay in the queue."""
        taken: list[PendingUpdate] = []
        cost = 0
        with self._lock:
            while self._waiting and cost < max_voxels:
                start, _, agent_id = heapq.heappop(self._waiting)
                self._now = start
                update = self._pending[agent_id][0]
                own_cost = _MESSAGE_COST + min(len(update.subset.batch) - update.next_voxel, SLICE_VOXELS)
                self._finish[agent_id] = start + own_cost
                cost += own_cost
                taken.append(update)
        return taken

    def put_back(self, update: PendingUpdate, is_done: bool) -> None:
        """Let the agent of a taken message wait for its next slice, or for its next message."""
        agent_id = update.subset.agent_id
        with self._lock:
            own = self._pending[agent_id]
            if is_done:
                own.popleft()
            if own:
                self._wait(agent_id)
            else:
                del self._pending[agent_id]
            if not self._pending:
                # nobody waits, so no agent has an advantage or a debt
                self._finish.clear()
                self._now = 0.0

    def _wait(self, agent_id: str) -> None:
        start = max(self._now, self._finish.get(agent_id, 0.0))
        self._arrivals += 1
        heapq.heappush(self._waiting, (start, self._arrivals, agent_id))
