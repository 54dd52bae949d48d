"""The layers of the fused map, the vote and the refinement, with the revision at which each voxel last changed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from threading import RLock

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.names import quote_name
from gausslite.domain.revision_log import RevisionLog
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import group_by_voxel, select_keys, select_voxels
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.change_log import ChangeLog
from gausslite.fusion.refined_map import RefinedMap
from gausslite.fusion.vote import FusedMap, fuse, rank_voxels, union_maps
from gausslite.fusion.vote_input import VoteInput


class MapLayer(StrEnum):
    """A map that watchers can follow; REFINED shows the vote in voxels that changed after the latest refinement."""

    VOTE = "vote"
    REFINED = "refined"


@dataclass(frozen=True, slots=True, eq=False)
class FusedMapChanges:
    """The fused voxels that changed up to `revision`, and the keys of those that became empty."""

    revision: int
    snapshot: bool
    fused: FusedMap
    removed: Int64[ndarray, " e"]


class FusedMapLayers:
    """Owns the change logs and the refined map; reads the updates from `votes`. Thread-safe, with the engine's lock."""

    def __init__(
        self, votes: VoteInput, lock: RLock, grid: VoxelGrid, first_revision: int, max_removed_voxels: int
    ) -> None:
        self._votes, self._lock, self._grid = votes, lock, grid
        self._change_log = ChangeLog(first_revision, max_removed_voxels)
        self._refined: RefinedMap | None = None
        self._refined_log = RevisionLog(first_revision, max_removed_voxels)
        self._refined_keys: set[int] = set()
        vote = rank_voxels(votes.scores())
        self._change_log.load(vote)
        if len(vote):
            self._refined_keys.update(vote.keys.tolist())
            self._refined_log.record(vote.keys.tolist(), (), first_revision + 1)

    def revision(self, layer: MapLayer = MapLayer.VOTE) -> int:
        """Return the layer's revision; it increases with every change."""
        with self._lock:
            return self._change_log.revision if layer is MapLayer.VOTE else self._refined_log.revision

    def size(self) -> tuple[int, int]:
        """Return the number of voxels and of Gaussians of the vote."""
        with self._lock:
            return self._change_log.fused_voxels, self._change_log.fused_gaussians

    def won_voxels(self, agent_id: str) -> int:
        """Return the number of voxels that the agent wins in the vote."""
        with self._lock:
            return self._change_log.won_voxels(agent_id)

    @property
    def is_refined(self) -> bool:
        """Return whether a refinement has been stored."""
        return self._refined is not None

    def record(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Record that what the vote reads of this agent changed in these voxels."""
        with self._lock:
            self._record(agent_id, keys)

    def changes(
        self, since_revision: int = 0, layer: MapLayer = MapLayer.VOTE, exclude_agent: str = ""
    ) -> FusedMapChanges:
        """Return the changes of a layer since a revision; the whole map for 0. Raises RevisionGoneError.

        exclude_agent: voxels that this agent wins count as empty; only for the vote. Raises InvalidInputError.
        """
        if layer is MapLayer.REFINED:
            if exclude_agent:
                raise InvalidInputError("exclude_agent_id: expected none with REFINED, whose voxels belong to everyone")
            return self._refined_changes(since_revision)
        with self._lock:
            revision = self._change_log.revision
            keys = None if since_revision == 0 else self._change_log.changed_since(since_revision)
            batches = self._votes.batches(keys)
        fused = fuse(batches)
        if exclude_agent:
            fused = FusedMap(select_voxels(fused.batch, ~fused.won_by(exclude_agent)), fused.vote)
        removed = np.zeros(0, np.int64) if keys is None else np.setdiff1d(keys, fused.batch.keys)
        return FusedMapChanges(revision, since_revision == 0, fused, removed)

    def voted_map(self, only_agent: str = "") -> VoxelBatch:
        """Return the fused map, or its voxels that one agent wins."""
        fused = fuse(self._votes.batches())
        if not only_agent:
            return fused.batch
        self._require_contributor(only_agent)
        return select_voxels(fused.batch, fused.won_by(only_agent))

    def union_map(self, only_agent: str = "") -> VoxelBatch:
        """Return all agents' Gaussians, or one agent's."""
        batches = self._votes.batches()
        if only_agent:
            self._require_contributor(only_agent)
            batches = {only_agent: batches[only_agent]}
        return union_maps(batches)

    def store_refined(self, gaussians: Gaussians, revision: int) -> None:
        """Store the result of a refinement that started from the vote at this revision.

        Raises RevisionGoneError if the change log no longer reaches back.
        """
        refined = RefinedMap(group_by_voxel(gaussians, self._grid), revision)
        with self._lock:
            changed = set(self._change_log.changed_since(revision).tolist())
            shown = (set(refined.batch.keys.tolist()) - changed) | (self._refined_keys & changed)
            removed = self._refined_keys - shown
            self._refined_log.record(sorted(shown - changed), sorted(removed), self._refined_log.revision + 1)
            self._refined, self._refined_keys = refined, shown

    def refined_map(self) -> VoxelBatch:
        """Return the refined map; voxels that changed after the refinement started show the newer vote.

        Raises MismatchError before the first refinement, RevisionGoneError if the change log no longer reaches back.
        """
        with self._lock:
            refined = self._refined
            if refined is None:
                raise MismatchError("refined map: expected a refinement first, got none yet; call RefineFusedMap")
            changed = self._change_log.changed_since(refined.revision)
            batches = self._votes.batches(changed)
        return refined.replace_changed(fuse(batches), changed)

    def layer(self, layer: MapLayer) -> VoxelBatch:
        """Return the map that the layer shows now."""
        with self._lock:
            return self.refined_map() if layer is MapLayer.REFINED and self.is_refined else self.voted_map()

    def _refined_changes(self, since_revision: int) -> FusedMapChanges:
        with self._lock:
            revision = self._refined_log.revision
            keys = None if since_revision == 0 else self._refined_log.changed_since(since_revision)
            batch = self.layer(MapLayer.REFINED)
            vote = rank_voxels(self._votes.scores(keys))
        if keys is None:
            return FusedMapChanges(revision, True, FusedMap(batch, vote), np.zeros(0, np.int64))
        present = select_keys(batch, keys)
        return FusedMapChanges(revision, False, FusedMap(present, vote), np.setdiff1d(keys, present.keys))

    def _record(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        vote = rank_voxels(self._votes.scores(keys))
        fused_changes = self._change_log.record(agent_id, keys, vote)
        present = set(vote.keys.tolist())
        changed = [key for key in fused_changes.tolist() if key in present]
        removed = [key for key in fused_changes.tolist() if key not in present and key in self._refined_keys]
        if changed or removed:
            self._refined_log.record(changed, removed, self._refined_log.revision + 1)
            self._refined_keys.update(changed)
            self._refined_keys.difference_update(removed)

    def _require_contributor(self, agent_id: str) -> None:
        agents = self._votes.agents()
        if agent_id not in agents:
            expected = ", ".join(map(quote_name, agents[:8])) or "no agents yet"
            raise InvalidInputError(f"agent_id: expected a contributor ({expected}), got {quote_name(agent_id)}")
