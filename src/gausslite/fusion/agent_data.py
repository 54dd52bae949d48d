"""Delete what the mission holds of an agent, estimate its frame, and keep its earlier map until it is outgrown."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from threading import RLock
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.voxels import RoiSubset, select_voxels
from gausslite.fusion.alignment import SurfaceSamples, crop_to_overlap, fit_frame
from gausslite.fusion.frames import AlignmentSettings, AlignmentState, FrameAlignment, FrameAlignments
from gausslite.fusion.fused_map import FusedMapLayers
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import fuse
from gausslite.fusion.vote_input import FreeSpaceRecords, VoteInput

_log = logging.getLogger(__name__)
# no agent can join under such a name, because ids of agents hold no colon
_EARLIER_SUFFIX = ":earlier"


@runtime_checkable
class AgentPart(Protocol):
    """Holds data of agents."""

    def remove_agent(self, agent_id: str) -> object:
        """Delete or forget what is held of the agent."""
        ...


def earlier_map_of(agent_id: str) -> str:
    """Return the name under which the agent's earlier map takes part in the vote."""
    return agent_id + _EARLIER_SUFFIX


def is_earlier_map(name: str) -> bool:
    """Return whether this is the name of an earlier map instead of an agent."""
    return name.endswith(_EARLIER_SUFFIX)


class AgentData:
    """Deletes the agents' data in all parts of the engine. Not thread-safe; FusionEngine holds a lock.

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
        parts: Sequence[AgentPart],
    ) -> None:
        self._store, self._votes, self._maps, self._alignments = store, votes, maps, alignments
        self._parts = (alignments, *parts)

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
        """Delete the agent's earlier map if the new one is quarantined for no other reason; returns whether it was.

        Without a second agent, nothing but the earlier map defines the frame, and where the robot is now counts more.
        """
        name = earlier_map_of(agent_id)
        is_quarantined = self._alignments.get(agent_id).state is AlignmentState.QUARANTINED
        if not is_quarantined or self._alignments.earlier(agent_id) != {name}:
            return False
        _log.warning("agent %s: its new map does not fit its earlier one, which is deleted", quote_name(agent_id))
        self._remove(name)
        alignment = self._alignments.get(agent_id)
        self._alignments.put(
            agent_id, replace(alignment, state=AlignmentState.REFERENCE, segments=(), fit=None, message="")
        )
        self._maps.record(agent_id, self._votes.refresh(agent_id))
        return True

    def _remove(self, name: str) -> None:
        keys = np.union1d(self._store.remove_agent(name), self._votes.remove_agent(name))
        self._maps.record(name, keys)
        for part in self._parts:
            part.remove_agent(name)

    def _alignment_of_earlier(self, agent_id: str) -> FrameAlignment:
        own = self._alignments.get(agent_id)
        is_reference = own.state is AlignmentState.REFERENCE
        return FrameAlignment(own.order, AlignmentState.REFERENCE if is_reference else AlignmentState.ALIGNED)


_MIN_GAUSSIANS = 50
_MOVED_VOXELS = 3


class FrameAligner:
    """Finds the agents whose frame has to be estimated, and estimates it. Thread-safe, with the engine's lock."""

    def __init__(
        self,
        store: FusionStore,
        alignments: FrameAlignments,
        votes: VoteInput,
        free_space: FreeSpaceRecords,
        lock: RLock,
        settings: AlignmentSettings | None,
    ) -> None:
        """Without settings, frames are used as declared and nothing is estimated."""
        self._store, self._alignments, self._votes, self._lock = store, alignments, votes, lock
        self._free_space = free_space
        self._settings = settings
        self._free_space_changed: set[str] = set()
        self._changed: dict[str, set[int]] = {}
        self._next_seq: dict[str, int] = {}

    def record(self, agent_id: str, accepted: Int64[ndarray, " a"]) -> None:
        """Note that these voxels of an agent changed. The first agent that contributes is the reference."""
        self._changed.setdefault(agent_id, set()).update(accepted.tolist())
        alignment = self._alignments.get(agent_id)
        if alignment.state is AlignmentState.UNKNOWN and not self._alignments.earlier(agent_id):
            self._alignments.put(agent_id, replace(alignment, state=AlignmentState.REFERENCE))
        elif alignment.fit is None and agent_id not in self._next_seq:
            # fixes the order of the agents
            self._alignments.put(agent_id, alignment)
            self._next_seq[agent_id] = 0

    def record_free_space(self, agent_id: str) -> None:
        """Note that an agent's free space changed: agents after it without enough overlap are evaluated again."""
        self._free_space_changed |= {
            name
            for name in self._next_seq
            if agent_id in self._alignments.earlier(name) and self._alignments.get(name).fit is None
        }

    def due(self) -> tuple[str, ...]:
        """Return the agents with enough changed voxels for a new estimate."""
        if self._settings is None:
            return ()
        with self._lock:
            return tuple(name for name, changed in self._changed.items() if self._is_due(name, len(changed)))

    def estimate(self, agent_id: str) -> Int64[ndarray, " k"]:
        """Fit the agent's recent updates to the maps before it; returns the fused voxels that may have changed."""
        assert self._settings is not None
        with self._lock:
            self._changed[agent_id] = set()
            self._free_space_changed.discard(agent_id)
            alignment = self._alignments.get(agent_id)
            first_seq = self._next_seq.get(agent_id, 0)
            source = self._recent(agent_id, first_seq)
            reference = self._reference(agent_id)
            highest_seq = self._store.totals(agent_id).highest_update_seq
        # QUARANTINED agents are fitted from their declared frame, so that they can return
        start = alignment.declared if alignment.state is AlignmentState.QUARANTINED else alignment.T_fused_agent
        overlap, near = crop_to_overlap(source, reference, start)
        fit = fit_frame(overlap, SurfaceSamples.of(near), start) if len(near) >= _MIN_GAUSSIANS else None
        with self._lock:
            if self._alignments.get(agent_id) is not alignment:
                return np.zeros(0, np.int64)
            if fit is None or self._settings.is_chance(fit):
                contradicted = self._contradicted_share(agent_id, move_gaussians(source, start))
                aligned = alignment.without_overlap(contradicted, self._settings)
            else:
                aligned = alignment.after_fit(fit, first_seq, self._settings)
                self._next_seq[agent_id] = highest_seq + 1
            return self._apply(agent_id, alignment, aligned)

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent."""
        self._changed.pop(agent_id, None)
        self._next_seq.pop(agent_id, None)
        self._free_space_changed.discard(agent_id)

    def _apply(self, agent_id: str, before: FrameAlignment, after: FrameAlignment) -> Int64[ndarray, " k"]:
        self._alignments.put(agent_id, after)
        if after.state is not before.state:
            level = logging.WARNING if after.state is AlignmentState.QUARANTINED else logging.INFO
            _log.log(
                level, "agent %s is %s%s", quote_name(agent_id), after.state, f": {after.message}" * bool(after.message)
            )
        was_used, is_used = (alignment.state is not AlignmentState.QUARANTINED for alignment in (before, after))
        if was_used == is_used and after.segments == before.segments:
            return np.zeros(0, np.int64)
        return self._votes.refresh(agent_id)

    def _is_due(self, agent_id: str, changed: int) -> bool:
        assert self._settings is not None
        if (changed == 0 and agent_id not in self._free_space_changed) or not self._alignments.earlier(agent_id):
            return False
        totals = self._store.totals(agent_id)
        has_enough = totals.gaussians >= _MIN_GAUSSIANS
        is_changed = changed >= self._settings.refit_share * totals.voxels
        return has_enough and (is_changed or agent_id in self._free_space_changed)

    def _contradicted_share(self, agent_id: str, moved: Gaussians) -> float:
        """Return the share of Gaussians in voxels that agents before this one have observed as free.

        Gaussians are counted and not voxels, because stray ones are few but have many voxels to themselves.
        """
        observers = self._alignments.earlier(agent_id) - self._alignments.in_other_frames()
        grid = self._free_space.grid
        inside = (np.abs(moved.means_m) < grid.max_coordinate_m).all(axis=1)
        keys, counts = np.unique(grid.keys(moved.means_m[inside]), return_counts=True)
        free = self._free_space.seen_by(observers, keys)
        # a few voxels are no evidence: an object may have been moved
        if np.count_nonzero(free) <= _MOVED_VOXELS:
            return 0.0
        return float(counts[free].sum() / len(moved))

    def _recent(self, agent_id: str, first_seq: int) -> Gaussians:
        """Return the Gaussians of the updates from first_seq on, or all if these are few."""
        batch = self._store.batch(agent_id)
        seqs = self._store.stored(agent_id, batch.keys).update_seqs
        recent = select_voxels(batch, seqs >= first_seq).gaussians
        return recent if len(recent) >= 4 * _MIN_GAUSSIANS else batch.gaussians

    def _reference(self, agent_id: str) -> Gaussians:
        earlier = self._alignments.earlier(agent_id)
        return Gaussians.concatenate([b.gaussians for name, b in self._votes.batches().items() if name in earlier])
