"""Delete what the mission holds of an agent, and keep its earlier map until it is outgrown."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError
from gausslite.domain.voxels import RoiSubset
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameAlignments
from gausslite.fusion.fused_map import FusedMapLayers
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import fuse
from gausslite.fusion.vote_input import VoteInput
from gausslite_places.frame_aligner import FrameAligner

_log = logging.getLogger(__name__)
# no agent can join under such a name, because ids of agents hold no colon
_EARLIER_SUFFIX = ":earlier"


def earlier_map_of(agent_id: str) -> str:
    """Return the name under which the agent's earlier map takes part in the vote."""
    return agent_id + _EARLIER_SUFFIX


def is_earlier_map(name: str) -> bool:
    """Return whether this is the name of an earlier map instead of an agent."""
    return name.endswith(_EARLIER_SUFFIX)


class AgentData:
    """Deletes the agents' data in all parts of the engine. Not thread-safe; FusionEngine holds a lock.

    delete_in_parts: deletes an agent's data in the parts that are not given themselves, each by its own call.

    An agent has at most two maps in the store: its own, and one merged from all before it ("earlier map"). The earlier
    map is in the fused frame and a source of the vote like any agent, so the agent's updates and tombstones do not
    change it. It wins a voxel until the agent's own Σkappa is higher. It is deleted when it wins no voxel.
    """

    def __init__(
        self,
        store: FusionStore,
        votes: VoteInput,
        maps: FusedMapLayers,
        alignments: FrameAlignments,
        aligner: FrameAligner,
        delete_in_parts: Sequence[Callable[[str], object]],
    ) -> None:
        self._store, self._votes, self._maps, self._alignments = store, votes, maps, alignments
        self._aligner = aligner
        self._delete_in_parts = alignments.remove_agent, aligner.remove_agent, *delete_in_parts

    def remove(self, agent_id: str) -> None:
        """Delete all data of the agent, with its earlier map. Raises StorageError."""
        self._remove(agent_id)
        self._remove(earlier_map_of(agent_id))

    def begin_new_map(self, agent_id: str) -> None:
        """Merge the agent's map into its earlier map, then delete all other data of the agent. Raises StorageError.

        Where both have a voxel, the one with the higher Σkappa is kept. A crash in between leaves the same Gaussians
        under both names, and the next call merges them again.
        """
        name, own = earlier_map_of(agent_id), self._votes.batch(agent_id)
        if int(own.counts.sum()) > 0:
            seq = self._store.totals(name).highest_update_seq + 1
            merged = fuse({agent_id: own, name: self._store.batch(name)}).batch
            self._store.put(RoiSubset(name, "", seq, seq, merged))
            if name not in self._alignments:
                self._alignments.put(name, self._alignment_of_earlier(agent_id))
            self._aligner.record(name, merged.keys)
            self._maps.record(name, merged.keys)
            _log.info("agent %s begins a new map; %d voxels of its earlier one are kept", agent_id, len(merged))
        self._remove(agent_id)

    def drop_outgrown(self, agent_id: str) -> None:
        """Delete the agent's earlier map if it wins no voxel."""
        name = earlier_map_of(agent_id)
        if self._store.totals(name).voxels and not self._maps.won_voxels(name):
            try:
                self._remove(name)
            except StorageError as error:
                # the updates of the caller are stored; the next one tries again
                _log.warning("the earlier map of agent %s is not deleted: %s", agent_id, error)

    def drop_contradicted(self, agent_id: str) -> bool:
        """Delete the agent's earlier map, which its new one contradicts: where the robot is now counts more."""
        _log.warning("agent %s: its new map does not fit its earlier one, which is deleted", quote_name(agent_id))
        self._remove(earlier_map_of(agent_id))
        return True

    def _remove(self, name: str) -> None:
        # the store last: a part waits for the end of what it writes
        for delete in self._delete_in_parts:
            delete(name)
        self._maps.record(name, np.union1d(self._store.remove_agent(name), self._votes.remove_agent(name)))

    def _alignment_of_earlier(self, agent_id: str) -> FrameAlignment:
        own = self._alignments.get(agent_id)
        is_reference = own.state is AlignmentState.REFERENCE
        state = AlignmentState.REFERENCE if is_reference else AlignmentState.ALIGNED
        return FrameAlignment(own.order, state, is_unknown=own.is_unknown)
