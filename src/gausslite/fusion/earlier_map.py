"""Keep the map of an agent that begins a new one: its earlier map stays in the vote until it is outgrown.

An agent has at most two maps in the store: its own, and one merged from all before it. The earlier map is in the fused
frame and a source of the vote like any agent, so the agent's updates and tombstones do not change it. It wins a voxel
until the agent's own Σkappa is higher. It is deleted when it wins no voxel.
"""

from __future__ import annotations

import logging

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameAlignments
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import fuse

_log = logging.getLogger(__name__)
# no agent can join under such a name, because ids of agents hold no colon
_EARLIER_SUFFIX = ":earlier"


def earlier_map_of(agent_id: str) -> str:
    """Return the name under which the agent's earlier map takes part in the vote."""
    return agent_id + _EARLIER_SUFFIX


def is_earlier_map(name: str) -> bool:
    """Return whether this is the name of an earlier map instead of an agent."""
    return name.endswith(_EARLIER_SUFFIX)


def keep_as_earlier(
    store: FusionStore, alignments: FrameAlignments, agent_id: str, own: VoxelBatch
) -> Int64[ndarray, " v"]:
    """Merge an agent's map, in the fused frame, into its earlier map; returns the voxels of that. Raises StorageError.

    Where both have a voxel, the one with the higher Σkappa is kept. After a crash before the agent's data are deleted,
    both names have the same Gaussians, and the next call merges them again.
    """
    name = earlier_map_of(agent_id)
    if int(own.counts.sum()) == 0:
        return np.zeros(0, np.int64)
    seq = store.totals(name).highest_update_seq + 1
    merged = fuse({agent_id: own, name: store.batch(name)}).batch
    store.put(RoiSubset(name, "", seq, seq, merged))
    if name not in alignments:
        before = alignments.get(agent_id)
        is_reference = before.state is AlignmentState.REFERENCE
        state = AlignmentState.REFERENCE if is_reference else AlignmentState.ALIGNED
        alignments.add(name, FrameAlignment(before.order, state, is_unknown=before.is_unknown))
    _log.info("agent %s begins a new map; %d voxels of its earlier one are kept", agent_id, len(merged))
    return merged.keys
