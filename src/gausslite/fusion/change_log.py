"""Record which agent wins each voxel and at which revision the voxel last changed, for the status and the watchers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from copy import copy

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.voxel_changes import MAX_REMOVED_VOXELS, RevisionLog
from gausslite.domain.voxels import tile_of, tiles_of
from gausslite.fusion.vote import VoteResult


class VoxelLog:
    """One layer of the fused map: its voxels, and the revision of the last change of each and of each tile.

    A tile has 16 x 16 x 16 voxels; its name is the smallest key that it can hold. Not thread-safe.
    """

    def __init__(self, first_revision: int, max_removed: int) -> None:
        self.revisions = RevisionLog(first_revision, max_removed)
        self._keys: dict[int, set[int]] = {}
        self._tile_revisions: dict[int, int] = {}

    def __contains__(self, key: int) -> bool:
        return key in self._keys.get(tile_of(key), ())

    def copy(self) -> VoxelLog:
        """Return an equal log that changes on its own."""
        other = copy(self)
        other.revisions, other._tile_revisions = self.revisions.copy(), dict(self._tile_revisions)
        other._keys = {tile: set(keys) for tile, keys in self._keys.items()}
        return other

    def tiles(self) -> Int64[ndarray, " t"]:
        """Return the tiles that have voxels, ascending."""
        return np.sort(np.fromiter(self._keys, np.int64, len(self._keys)))

    def keys(self, tile: int) -> Int64[ndarray, " k"]:
        """Return the voxels of a tile, ascending."""
        return np.array(sorted(self._keys.get(tile, ())), np.int64)

    def all_keys(self) -> Int64[ndarray, " k"]:
        """Return the voxels of all tiles, ascending."""
        return np.array(sorted(set().union(*self._keys.values())), np.int64)

    def tile_revision(self, tile: int) -> int:
        """Return the revision of the last change in a tile; 0 if it never had voxels."""
        return self._tile_revisions.get(tile, 0)

    def record(self, changed: Collection[int], removed: Collection[int] = ()) -> None:
        """Record as one revision that these voxels changed or became empty; nothing without any."""
        if not (changed or removed):
            return
        revision = self.revisions.revision + 1
        self.revisions.record(changed, removed, revision)
        tiles = tiles_of(np.fromiter(changed, np.int64, len(changed))).tolist()
        for key, tile in zip(changed, tiles, strict=True):
            self._keys.setdefault(tile, set()).add(key)
        self._tile_revisions.update(dict.fromkeys(tiles, revision))
        for key in removed:
            tile = tile_of(key)
            own = self._keys.get(tile, set())
            own.discard(key)
            if not own:
                self._keys.pop(tile, None)
            self._tile_revisions[tile] = revision


class ChangeLog:
    """Count the revisions of the fused map since the server started, and store each voxel's winner with its Gaussians.

    `first_revision` must exceed all revisions from before a restart.
    """

    def __init__(self, first_revision: int, max_removed: int = MAX_REMOVED_VOXELS) -> None:
        self.voxels = VoxelLog(first_revision, max_removed)
        self._winner: dict[int, tuple[str, int]] = {}
        self._won_voxels: dict[str, int] = {}
        self.fused_gaussians = 0
        """The number of Gaussians of the fused map."""

    @property
    def fused_voxels(self) -> int:
        """The number of voxels of the fused map."""
        return len(self._winner)

    def won_voxels(self, agent_id: str) -> int:
        """Return the number of voxels that the agent wins."""
        return self._won_voxels.get(agent_id, 0)

    def winners(self, keys: Iterable[int]) -> dict[str, list[int]]:
        """Return those of the voxels that are in the fused map, by winner."""
        won: dict[str, list[int]] = {}
        for key in keys:
            winner = self._winner.get(key)
            if winner is not None:
                won.setdefault(winner[0], []).append(key)
        return won

    def load(self, vote: VoteResult) -> None:
        """Record the first result of the vote, on all voxels."""
        winners = _winners(vote)
        for key, winner in winners.items():
            self._set(key, winner)
        self.voxels.record(winners.keys())

    def record(self, changed_keys: Mapping[str, Int64[ndarray, " _"]], vote: VoteResult) -> Int64[ndarray, " c"]:
        """Record which voxels changed by agent, as one revision; `vote` is the new result on these voxels.

        Returns the voxels where the fused map changed: those that such an agent wins now or won before.
        """
        new_winner = _winners(vote)
        changed: dict[int, None] = {}
        removed: dict[int, None] = {}
        for agent_id, keys in changed_keys.items():
            for key in keys.tolist():
                new, old = new_winner.get(key), self._winner.get(key)
                # after another agent has replaced the old winner, `old` is the new one
                if agent_id in (new and new[0], old and old[0]):
                    if new != old:
                        self._set(key, new)
                    (removed if new is None else changed)[key] = None
        self.voxels.record(changed.keys(), removed.keys())
        return np.array(sorted([*changed, *removed]), np.int64)

    def _set(self, key: int, new: tuple[str, int] | None) -> None:
        old = self._winner.pop(key, None)
        if old is not None:
            self._won_voxels[old[0]] -= 1
            self.fused_gaussians -= old[1]
        if new is not None:
            self._winner[key] = new
            self._won_voxels[new[0]] = self._won_voxels.get(new[0], 0) + 1
            self.fused_gaussians += new[1]


def _winners(vote: VoteResult) -> dict[int, tuple[str, int]]:
    """Return the winner of each voxel and the number of its Gaussians."""
    winners = vote.winners
    names = (winners.agents[index] for index in winners.agent_index.tolist())
    counts = winners.scores["counts"].tolist()
    return dict(zip(winners.scores["keys"].tolist(), zip(names, counts, strict=True), strict=True))
