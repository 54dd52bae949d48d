"""Commit the agents' updates in groups: one transaction and one synchronisation of the disk for many messages."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock, RLock

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import PutOutcome
from gausslite.fusion.update_queue import PendingUpdate, UpdateQueue

_GROUP_VOXELS = 4096
Check = Callable[[PendingUpdate], RoiSubset]
"""Returns the message as it is stored. Raises GaussLiteError to refuse it."""
Record = Callable[[RoiSubset, PutOutcome], None]
"""Notes what a commit has stored."""


class UpdateCommitter:
    """Owns the queue. Messages are checked and recorded under the engine's lock, and committed without it.

    A message with more than SLICE_VOXELS voxels is stored in several transactions. If one of them fails, the stored
    part stays; it is a part of the agent's newest data, and sending the message again completes it. Thread-safe.
    """

    def __init__(self, store: FusionStore, lock: RLock, check: Check, record: Record) -> None:
        self._store, self._lock, self._check, self._record = store, lock, check, record
        self._queue = UpdateQueue()
        self.committing = Lock()
        """Held through a commit; who deletes an agent's data takes it before the engine's lock."""

    def add(self, session_id: str, subset: RoiSubset) -> Future[PutOutcome]:
        """Queue a message; the future has its outcome after a commit. Raises UnavailableError."""
        update = PendingUpdate(session_id, subset)
        self._queue.add(update)
        return update.future

    def commit(self) -> None:
        """Commit the queued messages, group by group, until none waits."""
        while self._queue.has_waiting:
            with self.committing:
                group = self._queue.take(_GROUP_VOXELS)
                try:
                    self._commit(group)
                except Exception as error:
                    # reaches the senders through their futures
                    for update in group:
                        _fail(update, error)
                finally:
                    for update in group:
                        self._queue.put_back(update, update.future.done())

    def _commit(self, group: list[PendingUpdate]) -> None:
        checked: list[tuple[PendingUpdate, RoiSubset]] = []
        with self._lock:
            for update in group:
                try:
                    update.subset = self._check(update)
                    checked.append((update, update.next_slice()))
                except GaussLiteError as error:
                    _fail(update, error)
        outcomes = self._put(checked)
        with self._lock:
            for (_, part), outcome in zip(checked, outcomes, strict=True):
                if outcome is not None:
                    self._record(part, outcome)
        for (update, _), outcome in zip(checked, outcomes, strict=True):
            if outcome is not None and update.add_outcome(outcome):
                update.future.set_result(update.outcome())

    def _put(self, checked: list[tuple[PendingUpdate, RoiSubset]]) -> list[PutOutcome | None]:
        """Store the messages; if the group fails, each alone, so that one too large for the disk fails alone."""
        try:
            return list(self._store.put_all([part for _, part in checked]))
        except GaussLiteError:
            return [self._put_alone(update, part) for update, part in checked]

    def _put_alone(self, update: PendingUpdate, part: RoiSubset) -> PutOutcome | None:
        try:
            return self._store.put(part)
        except GaussLiteError as error:
            _fail(update, error)
            return None


def _fail(update: PendingUpdate, error: BaseException) -> None:
    if not update.future.done():
        update.future.set_exception(error)
