"""The way of an update into the store: checked, queued with a fair share for each agent, committed in groups."""

from __future__ import annotations

import contextlib
import heapq
import logging
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Any

import numpy as np

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.codec.subset_codec import declared_bytes, unpack_subset
from gausslite.domain import errors
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.limits import Quotas
from gausslite.fusion.store import FusionStore
from gausslite.fusion.update_log import PutOutcome, require_storable

MAX_SEQ_STEP = 1 << 32
"""An honest agent counts its messages; a larger step would let one message use up all later numbers."""
RECORD = "first-joined"
_SECONDS = struct.Struct("<d")
# no agent can have an empty id
_CLOCK = "", "mission-clock"
_SAVE_INTERVAL_S = 60.0
_LONGEST_PAUSE_S = 86_400.0
SLICE_VOXELS = 2048
"""A larger message is stored in parts of this size, so that it does not delay the other agents."""
_MESSAGE_BYTES = 1024
"""The cost of a message beside its content."""
_MAX_PENDING, _AGENT_BYTES = 64, 4 << 20
"""Of one agent; a robot waits for each acknowledgement, so it has one or two."""
_TOTAL_BYTES = 64 << 20
_GROUP_BYTES = 1 << 19
"""Of about 20 messages of a robot; a message that comes during a commit waits for its end."""
_LATE_S, _LATE_LOG_S = 2.0, 10.0
_log = logging.getLogger(__name__)


def require_own(agent_id: str, named: str, grid: VoxelGrid, expected: VoxelGrid) -> None:
    """Raise NotPermittedError for another agent's name, MismatchError for another grid."""
    if named != agent_id:
        raise errors.NotPermittedError(f"subset agent_id: expected {quote_name(agent_id)}, got {quote_name(named)}")
    if grid != expected:
        raise errors.MismatchError(f"voxel size: this mission votes on {expected.size_m:g} m, got {grid.size_m:g} m")


class MissionClock:
    """Gives the time in seconds. It starts at the wall clock's and runs with the monotonic one, so it never goes back.

    It persists with the store. The time without a server counts as the wall clock has it, up to a day.
    """

    def __init__(
        self,
        store: FusionStore,
        wall_s: Callable[[], float] = time.time,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store, self._monotonic_s = store, monotonic_s
        stored = store.find_record(*_CLOCK)
        start_s = wall_s()
        if stored:
            saved_s = float(_SECONDS.unpack(stored)[0])
            start_s = min(max(start_s, saved_s), saved_s + _LONGEST_PAUSE_S)
        self._offset_s = start_s - monotonic_s()
        self._next_save_s = start_s

    def __call__(self) -> float:
        """Return the time; it is saved once a minute."""
        now_s = self._monotonic_s() + self._offset_s
        if now_s >= self._next_save_s:
            # the next minute tries again, and the time since then counts from the wall clock
            with contextlib.suppress(StorageError):
                self._store.save_record(*_CLOCK, _SECONDS.pack(now_s))
            self._next_save_s = now_s + _SAVE_INTERVAL_S
        return now_s


class UpdateChecks:
    """Knows when each agent first joined. Not thread-safe: FusionEngine calls it for one change at a time.

    The first joins persist with the store, those at its other servers too. clock_s: the mission's time in seconds.
    """

    def __init__(self, store: FusionStore, quotas: Quotas, clock_s: Callable[[], float]) -> None:
        self._store, self._quotas, self._clock_s = store, quotas, clock_s
        self._first_joined_s = {agent_id: _SECONDS.unpack(data)[0] for agent_id, data in store.records(RECORD).items()}

    def record_join(self, agent_id: str) -> None:
        """Note the agent's first join. Raises StorageError."""
        if agent_id not in self._first_joined_s:
            now_s = self._clock_s()
            self._store.save_record(agent_id, RECORD, _SECONDS.pack(now_s))
            self._first_joined_s[agent_id] = now_s

    def require_permitted(self, subset: EncodedSubset) -> None:
        """Raise InvalidInputError for a number that a store cannot keep, or a sequence number far above those before.

        Raises QuotaError for a kappa that no robot can have reached, as the bound grows with the time since its first
        join, and for more voxels (with tombstones) or Gaussians than an agent may have.
        """
        require_storable(subset)
        name, highest = quote_name(subset.agent_id), self._store.totals(subset.agent_id).highest_update_seq
        if subset.update_seq > highest + MAX_SEQ_STEP:
            raise errors.InvalidInputError(
                f"agent {name}: expected an update_seq of at most {highest + MAX_SEQ_STEP}, got {subset.update_seq}"
            )
        largest, bound = int(subset.voxels.gaussians["kappa"].max(initial=0)), self._kappa_bound(subset.agent_id)
        if largest > bound:
            raise errors.QuotaError(
                f"agent {name}: expected a kappa of at most {bound} this long after its first join, got {largest}"
            )
        self._require_within_quotas(subset)

    def _require_within_quotas(self, subset: EncodedSubset) -> None:
        """Raise QuotaError if the agent would have too many voxels (with tombstones) or Gaussians."""
        stored = self._store.scores_of(subset.agent_id, subset.voxels.keys)
        totals = self._store.totals(subset.agent_id)
        # equal numbers count as newer: a larger content replaces the stored one, and a duplicate adds nothing
        newer = stored["update_seqs"] <= subset.update_seq
        added = subset.voxels.counts[newer].sum(dtype=np.int64) - stored["counts"][newer].sum(dtype=np.int64)
        for name, value, limit in (
            ("voxels", totals.voxels + int(np.count_nonzero(stored["update_seqs"] < 0)), self._quotas.voxels_per_agent),
            ("Gaussians", totals.gaussians + int(added), self._quotas.gaussians_per_agent),
        ):
            if value > limit:
                raise errors.QuotaError(
                    f"agent {quote_name(subset.agent_id)}: expected at most {limit} {name} in all, got {value}"
                )

    def remove_agent(self, agent_id: str) -> None:
        """Delete what is known of the agent; the store deletes its records."""
        self._first_joined_s.pop(agent_id, None)

    def _kappa_bound(self, agent_id: str) -> int:
        """Return the largest plausible kappa: the iterations before the first join, and those since then."""
        now_s = self._clock_s()
        if agent_id not in self._first_joined_s:
            stored = self._store.find_record(agent_id, RECORD)
            self._first_joined_s[agent_id] = _SECONDS.unpack(stored)[0] if stored else now_s
        elapsed_s = max(0.0, now_s - self._first_joined_s[agent_id])
        return self._quotas.kappa_at_join + int(self._quotas.kappa_per_second * elapsed_s)


@dataclass(slots=True, eq=False)
class PendingUpdate:
    """A message that waits for its commit, encoded or as it is stored. `outcomes` has those of the stored slices."""

    session_id: str
    agent_id: str
    message: bytes | EncodedSubset
    future: Future[Any] = field(default_factory=Future)  # has its outcome, or its content where it is only decoded
    next_voxel: int = 0  # the first one that is not stored yet
    outcomes: list[PutOutcome] = field(default_factory=list)
    queued_s: float = field(default_factory=time.monotonic)  # arrival, of the monotonic clock

    def __post_init__(self) -> None:
        # a client that disconnects cannot cancel it any more: the message is stored in any case
        self.future.set_running_or_notify_cancel()

    @property
    def subset(self) -> EncodedSubset:
        """The decoded message."""
        assert isinstance(self.message, EncodedSubset)
        return self.message

    @property
    def encoded_bytes(self) -> int:
        """The size of a message that is not decoded yet."""
        return len(self.message) if isinstance(self.message, bytes) else 0

    @property
    def cost(self) -> int:
        """The bytes to decode and to store next."""
        if isinstance(self.message, bytes):
            return _MESSAGE_BYTES + max(len(self.message), declared_bytes(self.message))
        voxels = self.message.voxels
        share = min(SLICE_VOXELS / max(len(voxels), 1), 1.0)
        return _MESSAGE_BYTES + int(share * (voxels.voxels.nbytes + voxels.gaussians.nbytes))

    def decode(self, grid: VoxelGrid) -> None:
        """Decode the message, as a store keeps it; the future of one that cannot be decoded has the error."""
        if isinstance(self.message, EncodedSubset):
            return
        try:
            subset, own_grid = unpack_subset(self.message)
            require_own(self.agent_id, subset.agent_id, own_grid, grid)
            self.message = subset
        except Exception as error:
            # the thread decodes the messages of several agents
            self.fail(error)

    def next_slice(self) -> EncodedSubset:
        """Return the part of the message to store next."""
        subset, start = self.subset, self.next_voxel
        if len(subset.voxels) <= SLICE_VOXELS:
            return subset
        return replace(subset, voxels=subset.voxels.slice(start, start + SLICE_VOXELS))

    def fail(self, error: BaseException) -> None:
        """Refuse the message, unless it has its answer."""
        if not self.future.done():
            self.future.set_exception(error)

    def add_outcome(self, outcome: PutOutcome) -> bool:
        """Note that the next slice is stored; returns whether it was the last one."""
        self.outcomes.append(outcome)
        self.next_voxel += SLICE_VOXELS
        return self.next_voxel >= len(self.subset.voxels)

    def outcome(self) -> PutOutcome:
        """Return the outcome of the whole message."""
        return PutOutcome(
            np.concatenate([outcome.accepted for outcome in self.outcomes]),
            np.concatenate([outcome.stale for outcome in self.outcomes]),
        )


class UpdateQueue:
    """Fair queueing over the agents, by the bytes and Gaussians of their messages. Thread-safe.

    It stands before decoding: a message costs its size, or what its header declares if that is more. Messages are taken
    in the order in which a server that works for all waiting agents at once, byte by byte, would finish them. So a
    small message passes the large ones of any number of agents, until it has had its share.

    Source: A. Demers et al., "Analysis and simulation of a fair queueing algorithm", SIGCOMM 1989.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._pending: dict[str, deque[PendingUpdate]] = {}
        # (round of the end, order of arrival, agent id) of each agent with pending messages
        self._waiting: list[tuple[float, int, str]] = []
        self._finish: dict[str, float] = {}
        # the bytes that each waiting agent would have had
        self._round = 0.0
        self._arrivals = self._bytes = 0
        self._next_log_s = 0.0

    def add(self, update: PendingUpdate) -> None:
        """Queue a message. Raises UnavailableError if its agent, or all agents together, have too many."""
        agent_id, size = update.agent_id, update.encoded_bytes
        with self._lock:
            own = self._pending.get(agent_id, ())
            if own and (
                len(own) >= _MAX_PENDING or size + sum(waiting.encoded_bytes for waiting in own) > _AGENT_BYTES
            ):
                raise errors.UnavailableError(
                    f"agent {quote_name(agent_id)}: expected at most {_MAX_PENDING} messages and {_AGENT_BYTES >> 20} "
                    "MiB that wait for their acknowledgement; wait for some"
                )
            if self._bytes + size > _TOTAL_BYTES:
                raise errors.UnavailableError(
                    f"fusion server: {len(self._pending)} agents have {self._bytes >> 20} MiB that wait for their "
                    "acknowledgement; try again in a moment"
                )
            self._bytes += size
            self._pending.setdefault(agent_id, deque()).append(update)
            if not own:
                self._wait(agent_id)

    def take(self, max_bytes: int = _GROUP_BYTES) -> list[PendingUpdate]:
        """Return the first message of the agents whose turn it is, at least one if any wait; they stay in the queue.

        Together they cost `max_bytes` at most, so that small messages do not wait for a large one in their group.
        """
        taken: list[PendingUpdate] = []
        cost = 0
        with self._lock:
            while self._waiting:
                agent_id = self._waiting[0][2]
                update = self._pending[agent_id][0]
                own_cost = update.cost
                if taken and cost + own_cost > max_bytes:  # at least one, however large
                    break
                heapq.heappop(self._waiting)
                self._round += own_cost / len(self._pending)  # the waiting agents share the time equally
                cost += own_cost
                # it is decoded now
                self._bytes -= update.encoded_bytes
                taken.append(update)
                self._log_if_late(update)
        return taken

    def put_back(self, update: PendingUpdate) -> None:
        """Let the agent of a taken message wait for its next slice or, if this one has its answer, its next message."""
        agent_id = update.agent_id
        with self._lock:
            own = self._pending[agent_id]
            if update.future.done():
                own.popleft()
            if own:
                self._wait(agent_id)
            else:
                del self._pending[agent_id]
            if not self._pending:
                # nobody waits, so no agent has an advantage or a debt
                self._finish.clear()
                self._round = 0.0

    def _log_if_late(self, update: PendingUpdate) -> None:
        now_s = time.monotonic()
        if update.encoded_bytes and now_s - update.queued_s > _LATE_S and now_s >= self._next_log_s:
            self._next_log_s = now_s + _LATE_LOG_S
            _log.warning(
                "messages are late: one of agent %s has waited %.1f s", update.agent_id, now_s - update.queued_s
            )

    def _wait(self, agent_id: str) -> None:
        finish = max(self._round, self._finish.get(agent_id, 0.0)) + self._pending[agent_id][0].cost
        self._finish[agent_id] = finish
        self._arrivals += 1
        heapq.heappush(self._waiting, (finish, self._arrivals, agent_id))


def store_slices(store: FusionStore, group: Sequence[PendingUpdate]) -> list[tuple[PendingUpdate, PutOutcome]]:
    """Store the next slice of each message; returns those that were stored. The futures of the others have the error.

    If the group fails, each is stored alone, so that one too large for the disk fails alone. A message with more than
    SLICE_VOXELS voxels is stored in several transactions. If one of them fails, the stored part stays; it is a part of
    the agent's newest data, and sending the message again completes it.
    """
    if not group:
        return []
    try:
        return list(zip(group, store.put_all([update.next_slice() for update in group]), strict=True))
    except errors.GaussLiteError as error:
        if len(group) > 1:
            return [stored for update in group for stored in store_slices(store, [update])]
        group[0].fail(error)
        return []
