"""Refuse messages after which the store would keep more of an agent than its quotas allow."""

from __future__ import annotations

import numpy as np

from gausslite.domain.errors import QuotaError
from gausslite.domain.names import quote_name
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.fusion.limits import Quotas
from gausslite.fusion.store import FusionStore


def require_within_quotas(subset: RoiSubset, store: FusionStore, quotas: Quotas) -> None:
    """Raise QuotaError if the agent would have too many voxels (with tombstones) or Gaussians."""
    stored, totals = store.stored(subset.agent_id, subset.batch.keys), store.totals(subset.agent_id)
    # equal numbers count as newer: a larger content replaces the stored one, and a duplicate adds nothing
    newer = stored.update_seqs <= subset.update_seq
    added = subset.batch.counts[newer].sum(dtype=np.int64) - stored.counts[newer].sum(dtype=np.int64)
    for name, value, limit in (
        ("voxels", totals.voxels + int(np.count_nonzero(stored.update_seqs < 0)), quotas.voxels_per_agent),
        ("Gaussians", totals.gaussians + int(added), quotas.gaussians_per_agent),
    ):
        if value > limit:
            raise QuotaError(
                f"agent {quote_name(subset.agent_id)}: expected at most {limit} {name} in all, got {value}"
            )
