"""Check what an agent states about its updates: Σkappa is computed, kappa and sequence numbers are bounded."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.names import quote_name
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.fusion.limits import Quotas
from gausslite.fusion.store import FusionStore

MAX_SEQ_STEP = 1 << 32
"""An honest agent counts its messages; a larger step would let one message use up all later numbers."""
RECORD = "first-joined"
_JOINED = struct.Struct("<d")


class UpdateChecks:
    """Knows when each agent first joined. Not thread-safe; FusionEngine holds a lock.

    The first joins persist with the store. clock_s: the time since the epoch in seconds.
    """

    def __init__(self, store: FusionStore, quotas: Quotas, clock_s: Callable[[], float] = time.time) -> None:
        self._store, self._quotas, self._clock_s = store, quotas, clock_s
        self._first_joined_s = {agent_id: _JOINED.unpack(data)[0] for agent_id, data in store.records(RECORD).items()}

    def record_join(self, agent_id: str) -> None:
        """Note the agent's first join. Raises StorageError."""
        if agent_id not in self._first_joined_s:
            now_s = self._clock_s()
            self._store.save_record(agent_id, RECORD, _JOINED.pack(now_s))
            self._first_joined_s[agent_id] = now_s

    def check(self, subset: RoiSubset) -> RoiSubset:
        """Return the message with Σkappa computed from its Gaussians, whatever it declares.

        Raises InvalidInputError for a sequence number too far above the stored ones, QuotaError for a kappa that no
        robot can have reached yet: the bound grows with the time since its first join.
        """
        name, highest = quote_name(subset.agent_id), self._store.totals(subset.agent_id).highest_update_seq
        if subset.update_seq > highest + MAX_SEQ_STEP:
            raise InvalidInputError(
                f"agent {name}: expected an update_seq of at most {highest + MAX_SEQ_STEP}, got {subset.update_seq}"
            )
        batch = subset.batch
        largest, bound = int(batch.gaussians.kappa.max(initial=0)), self._kappa_bound(subset.agent_id)
        if largest > bound:
            raise QuotaError(
                f"agent {name}: expected a kappa of at most {bound} this long after its first join, got {largest}"
            )
        return replace(subset, batch=with_computed_sums(batch))

    def remove_agent(self, agent_id: str) -> None:
        """Delete what is known of the agent; the store deletes its records."""
        self._first_joined_s.pop(agent_id, None)

    def _kappa_bound(self, agent_id: str) -> int:
        """Return the largest plausible kappa: the iterations before the first join, and those since then."""
        now_s = self._clock_s()
        elapsed_s = max(0.0, now_s - self._first_joined_s.get(agent_id, now_s))
        return self._quotas.kappa_at_join + int(self._quotas.kappa_per_second * elapsed_s)


def with_computed_sums(batch: VoxelBatch) -> VoxelBatch:
    """Return the batch with the Σkappa of its own Gaussians (Sec. III-E)."""
    totals = np.concatenate([np.zeros(1, np.uint64), np.cumsum(batch.gaussians.kappa, dtype=np.uint64)])
    offsets = batch.offsets
    return replace(batch, kappa_sums=totals[offsets[1:]] - totals[offsets[:-1]])
