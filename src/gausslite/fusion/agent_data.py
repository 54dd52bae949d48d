"""Delete what the mission holds of an agent, and keep its earlier map until it is outgrown."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

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


class AgentPart(Protocol):
    """Holds something of each agent: sessions, keyframes, objects and others."""

    def remove_agent(self, agent_id: str) -> object:
        """Delete what is held of the agent, if anything."""


class AgentData:
    """Deletes the agents' data in all parts of the engine. Not thread-safe; FusionEngine holds a lock.

    An agent has at most two maps in the store: its own, and one merged from all before it ("earlier map"). The earlier
    map is in the fused frame and a source of the vote like any agent, so the agent's updates and tombstones do not
    change it. It wins a voxel until the agent's own Σkappa is higher. It is deleted when it wins no voxel.
    """

    def __init__(self, store: FusionStore, alignments: FrameAlignments, parts: Sequence[AgentPart]) -> None:
        self._store, self._alignments, self._parts = store, alignments, (alignments, *parts)

    def remove(self, name: str) -> Int64[ndarray, " v"]:
        """Delete all data of an agent, or an earlier map; returns the voxels that it had. Raises StorageError."""
        # the store last: a part waits for the end of what it writes
        for part in self._parts:
            part.remove_agent(name)
        return self._store.remove_agent(name)

    def keep_as_earlier(self, agent_id: str, own: VoxelBatch) -> Int64[ndarray, " v"]:
        """Merge the agent's map into its earlier map; returns the voxels of that. Raises StorageError.

        own: the agent's map in the fused frame. Where both have a voxel, the one with the higher Σkappa is kept. After
        a crash before the agent's data are deleted, both names have the same Gaussians, and the next call merges them
        again.
        """
        name = earlier_map_of(agent_id)
        if int(own.counts.sum()) == 0:
            return np.zeros(0, np.int64)
        seq = self._store.totals(name).highest_update_seq + 1
        merged = fuse({agent_id: own, name: self._store.batch(name)}).batch
        self._store.put(RoiSubset(name, "", seq, seq, merged))
        if name not in self._alignments:
            self._alignments.add(name, self._alignment_of_earlier(agent_id))
        _log.info("agent %s begins a new map; %d voxels of its earlier one are kept", agent_id, len(merged))
        return merged.keys

    def _alignment_of_earlier(self, agent_id: str) -> FrameAlignment:
        own = self._alignments.get(agent_id)
        is_reference = own.state is AlignmentState.REFERENCE
        state = AlignmentState.REFERENCE if is_reference else AlignmentState.ALIGNED
        return FrameAlignment(own.order, state, is_unknown=own.is_unknown)
