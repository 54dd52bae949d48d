"""Record which map wins each voxel and at which revision the voxel last changed, for the status and the watchers."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Mapping
from copy import copy

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import RevisionGoneError
from gausslite.fusion.packed_table import PackedTable, Table, keys_of, places_of, tiles_at
from gausslite.fusion.vote import VoteResult

MAX_REMOVED_VOXELS = 100_000
_CHANGED = np.dtype([("winners", "u2"), ("counts", "u4"), ("revisions", "i8")])
_NOBODY = (1 << 16) - 1
_ABSENT = np.array((_NOBODY, 0, 0), _CHANGED)
_NO_TILE = np.array((0, 0), np.dtype([("voxels", "u4"), ("revisions", "i8")]))


class VoxelLog:
    """One layer of a map: its voxels, and the revision of the last change of each and of each tile.

    It has 22 bytes for each voxel of the layer, and the latest `max_removed` voxels that became empty. A watcher that
    misses an older removal has to begin with a snapshot. `first_revision` must exceed all revisions from before a
    restart. A tile has 16 x 16 x 16 voxels; its name is the smallest key that it can hold. Not thread-safe.
    """

    def __init__(self, first_revision: int, max_removed: int = MAX_REMOVED_VOXELS) -> None:
        self.revision = self._oldest = first_revision
        self._max_removed = max_removed
        self._voxels, self._tiles = PackedTable(_ABSENT), PackedTable(_NO_TILE)
        # in the order of the revisions
        self._removed_at: OrderedDict[int, int] = OrderedDict()

    def copy(self) -> VoxelLog:
        """Return an equal log that changes on its own."""
        other = copy(self)
        other._voxels, other._tiles = self._voxels.copy(), self._tiles.copy()
        other._removed_at = OrderedDict(self._removed_at)
        return other

    def tiles(self) -> Int64[ndarray, " t"]:
        """Return the tiles that have voxels, ascending."""
        return keys_of(self._tiles.select()[0])

    def keys(self, tile: int) -> Int64[ndarray, " k"]:
        """Return the voxels of a tile, ascending."""
        return keys_of(self._voxels.in_tiles(places_of(np.array([tile])))[0])

    def all_keys(self) -> Int64[ndarray, " k"]:
        """Return the voxels of all tiles, ascending."""
        return np.sort(keys_of(self._voxels.select()[0]))

    def tile_revision(self, tile: int) -> int:
        """Return the revision of the last change in a tile; the current one if it has no voxels."""
        own = self._tiles.get(places_of(np.array([tile])))[0]
        return int(own["revisions"]) if own["voxels"] else self.revision

    def find(self, keys: Int64[ndarray, " k"]) -> Table:
        """Return the winner, the number of Gaussians and the revision of each voxel; _ABSENT of others."""
        return self._voxels.get(places_of(keys))

    def changed_since(self, revision: int) -> Int64[ndarray, " c"]:
        """Return the keys of the voxels that changed or became empty after this revision, ascending.

        Raises RevisionGoneError if the revision is from before a restart, or older than a removal no longer recorded.
        """
        if not self._oldest <= revision <= self.revision:
            raise RevisionGoneError(
                f"since_revision: expected {self._oldest} to {self.revision}, or 0 for a snapshot, got {revision}"
            )
        if revision == self.revision:
            return np.zeros(0, np.int64)
        tiles, _ = self._tiles.select(lambda own: own["revisions"] > revision)
        places, voxels = self._voxels.in_tiles(tiles)
        recent = keys_of(places[voxels["revisions"] > revision])
        removed = itertools.takewhile(lambda key: self._removed_at[key] > revision, reversed(self._removed_at))
        return np.sort(np.append(recent, np.array(list(removed), np.int64)))

    def touch(self, keys: Int64[ndarray, " k"]) -> None:
        """Record as one revision that these voxels of the layer have changed."""
        self.record(keys, np.zeros(0, np.int64), self.find(keys))

    def record(
        self,
        changed: Int64[ndarray, " k"],
        removed: Int64[ndarray, " r"],
        won: Table | None = None,
        revision: int | None = None,
    ) -> None:
        """Record as one revision that these voxels changed or became empty; nothing without any.

        Keys ascend. won: the winner of each changed voxel, and the number of its Gaussians. revision: its number, by
        default the next one.
        """
        if not (len(changed) or len(removed)):
            return
        self.revision = self.revision + 1 if revision is None else revision
        keys, elements = np.append(changed, removed), np.full(len(changed) + len(removed), _ABSENT)
        elements[: len(changed)] = 0 if won is None else won
        elements["revisions"][: len(changed)] = self.revision
        places = places_of(keys)
        before = self._voxels.put(places, elements)
        added = self._voxels.is_present(elements).astype(np.int64) - self._voxels.is_present(before)
        numbers, index = np.unique(tiles_at(places), return_inverse=True)
        tiles = self._tiles.get(numbers)
        # unsigned numbers wrap around, so that a decrease is the addition of a large one
        np.add.at(tiles["voxels"], index, added.astype(np.uint32))
        tiles["revisions"] = self.revision
        self._tiles.put(numbers, tiles)
        for key in changed.tolist() if self._removed_at else ():
            self._removed_at.pop(key, None)
        for key in removed.tolist():
            self._removed_at[key] = self.revision
            if len(self._removed_at) > self._max_removed:
                _, dropped_revision = self._removed_at.popitem(last=False)
                self._oldest = max(self._oldest, dropped_revision)


class ChangeLog:
    """Count the revisions of the fused map since the server started, and store each voxel's winner with its Gaussians.

    `first_revision` must exceed all revisions from before a restart.
    """

    def __init__(self, first_revision: int, max_removed: int = MAX_REMOVED_VOXELS) -> None:
        self.voxels = VoxelLog(first_revision, max_removed)
        # of each map that has won a voxel: its number in the log
        self._numbers: dict[str, int] = {}
        self._won_voxels: dict[int, int] = {}
        self.fused_gaussians = 0
        """The number of Gaussians of the fused map."""

    @property
    def fused_voxels(self) -> int:
        """The number of voxels of the fused map."""
        return sum(self._won_voxels.values())

    def won_voxels(self, name: str) -> int:
        """Return the number of voxels that the map wins."""
        return self._won_voxels.get(self._numbers.get(name, _NOBODY), 0)

    def winners(self, keys: Int64[ndarray, " k"]) -> dict[str, Int64[ndarray, " w"]]:
        """Return those of the voxels that are in the fused map, by winner."""
        won = self.voxels.find(keys)["winners"]
        present = set(won.tolist())
        return {name: keys[won == number] for name, number in self._numbers.items() if number in present}

    def load(self, vote: VoteResult) -> None:
        """Record the first result of the vote, on all voxels."""
        self._record(vote.keys, np.full(len(vote), _ABSENT), self._winners(vote.keys, vote))

    def record(self, changed_keys: Mapping[str, Int64[ndarray, " _"]], vote: VoteResult) -> Int64[ndarray, " c"]:
        """Record which voxels changed by map, as one revision; `vote` is the new result on these voxels.

        Returns the voxels where the fused map changed: those that such a map wins now or won before.
        """
        keys = np.unique(np.concatenate([np.zeros(0, np.int64), *changed_keys.values()]))
        before, won = self.voxels.find(keys), self._winners(keys, vote)
        is_changed = np.zeros(len(keys), np.bool_)
        for name, own in changed_keys.items():
            number, places = self._numbers.get(name, _NOBODY + 1), np.searchsorted(keys, own)
            is_changed[places[(won["winners"][places] == number) | (before["winners"][places] == number)]] = True
        self._record(keys[is_changed], before[is_changed], won[is_changed])
        return keys[is_changed]

    def _record(self, keys: Int64[ndarray, " k"], before: Table, won: Table) -> None:
        for table, sign in ((before, -1), (won, 1)):
            self.fused_gaussians += sign * int(table["counts"].sum(dtype=np.int64))
            numbers, counts = np.unique(table["winners"][table["winners"] != _NOBODY], return_counts=True)
            for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                self._won_voxels[number] = self._won_voxels.get(number, 0) + sign * count
        is_present = won["winners"] != _NOBODY
        self.voxels.record(keys[is_present], keys[~is_present], won[is_present])

    def rename(self, name: str, other: str) -> None:
        """Give a map another name."""
        if name in self._numbers:
            self._numbers[other] = self._numbers.pop(name)

    def forget(self, name: str) -> None:
        """Free the number of a map that wins no voxel."""
        self._won_voxels.pop(self._numbers.pop(name, _NOBODY), None)

    def _winners(self, keys: Int64[ndarray, " k"], vote: VoteResult) -> Table:
        """Return the winner of each of these ascending voxels, and the number of its Gaussians."""
        won, winners = np.full(len(keys), _ABSENT), vote.winners
        numbers = np.zeros(len(winners.agents), np.uint16)
        for index in np.unique(winners.agent_index).tolist():
            numbers[index] = self._number(winners.agents[index])
        places = np.searchsorted(keys, winners.scores["keys"])
        won["winners"][places], won["counts"][places] = numbers[winners.agent_index], winners.scores["counts"]
        return won

    def _number(self, name: str) -> int:
        if name not in self._numbers:
            used = set(self._numbers.values())
            self._numbers[name] = next(number for number in itertools.count() if number not in used)
        return self._numbers[name]
