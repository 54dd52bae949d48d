"""Which revision of the fused map last changed each voxel, so that a watcher can be sent what is new to it."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.errors import RevisionGoneError
from gausslite.fusion.vote import VoteResult


class ChangeLog:
    """Counts the revisions of the fused map of one life of a server.

    For a voxel that holds something only its last change matters, so the ledger is bounded by the map. Of voxels that
    became empty the most recent `max_vanished` are remembered; who has not heard of an older one must start anew.
    first_revision tells this life's revisions from those of an earlier one: begin above all of them.
    """

    def __init__(self, first_revision: int = 1, max_vanished: int = 100_000) -> None:
        self._revision = self._oldest = first_revision
        self._max_vanished = max_vanished
        self._holder: dict[int, str] = {}
        self._changed: dict[int, int] = {}
        self._vanished: OrderedDict[int, int] = OrderedDict()

    @property
    def revision(self) -> int:
        """The fused map's present revision."""
        return self._revision

    def record(self, agent_id: str, keys: Int64[ndarray, " k"], election: VoteResult) -> Int64[ndarray, " c"]:
        """Note that this agent's words on `keys` changed and that the vote on them now stands so.

        Returns the voxels where the fused map changed: those the agent holds now or held before.
        """
        holders = dict(zip(election.keys.tolist(), election.winner.tolist(), strict=True))
        changed = []
        for key in keys.tolist():
            index = holders.get(key)
            after = None if index is None else election.agents[index]
            before = self._holder.get(key)
            if agent_id in (after, before):
                changed.append(key)
                self._move(key, after, self._revision + 1)
        if changed:
            self._revision += 1
        return np.array(sorted(changed), np.int64)

    def changed_since(self, revision: int) -> Int64[ndarray, " c"]:
        """The voxels whose present state someone at `revision` does not know, ascending.

        Raises RevisionGoneError when the revision is of another life, or too old to know what vanished since.
        """
        if not self._oldest <= revision <= self._revision:
            raise RevisionGoneError(
                f"since_revision: expected {self._oldest} to {self._revision}, or 0 for a snapshot, got {revision}"
            )
        keys = [key for changes in (self._changed, self._vanished) for key, at in changes.items() if at > revision]
        return np.array(sorted(keys), np.int64)

    def _move(self, key: int, after: str | None, revision: int) -> None:
        if after is not None:
            self._vanished.pop(key, None)
            self._holder[key] = after
            self._changed[key] = revision
            return
        del self._holder[key], self._changed[key]
        self._vanished[key] = revision
        if len(self._vanished) > self._max_vanished:
            _, forgotten = self._vanished.popitem(last=False)
            self._oldest = max(self._oldest, forgotten)
