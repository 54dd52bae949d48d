"""Record at which revision of the fused map each voxel last changed, for the streams of WatchFusedMap."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.revision_log import MAX_REMOVED_VOXELS, RevisionLog
from gausslite.fusion.vote import VoteResult


class ChangeLog:
    """Count the revisions of the fused map since the server started, and store each voxel's winner.

    `first_revision` must exceed all revisions from before a restart.
    """

    def __init__(self, first_revision: int = 1, max_removed: int = MAX_REMOVED_VOXELS) -> None:
        self._log = RevisionLog(first_revision, max_removed)
        self._winner: dict[int, str] = {}

    @property
    def revision(self) -> int:
        """The fused map's current revision."""
        return self._log.revision

    def record(self, agent_id: str, keys: Int64[ndarray, " k"], vote: VoteResult) -> Int64[ndarray, " c"]:
        """Record that this agent's updates of `keys` changed; `vote` is the new result on these voxels.

        Returns the voxels where the fused map changed: those that the agent wins now or won before.
        """
        new_winner = dict(zip(vote.keys.tolist(), vote.winner_index.tolist(), strict=True))
        changed, removed = [], []
        for key in keys.tolist():
            index = new_winner.get(key)
            winner = None if index is None else vote.agents[index]
            if agent_id not in (winner, self._winner.get(key)):
                continue
            if winner is None:
                del self._winner[key]
                removed.append(key)
            else:
                self._winner[key] = winner
                changed.append(key)
        if changed or removed:
            self._log.record(changed, removed, self._log.revision + 1)
        return np.array(sorted(changed + removed), np.int64)

    def changed_since(self, revision: int) -> Int64[ndarray, " c"]:
        """Return the voxels that changed or became empty after this revision, ascending. Raises RevisionGoneError."""
        return self._log.changed_since(revision)
