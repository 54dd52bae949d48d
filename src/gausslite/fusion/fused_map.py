"""The layers of the fused map, the vote and the refinement, with the revision at which each voxel last changed."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from threading import Lock

import numpy as np
from jaxtyping import Int64, UInt64
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from gausslite.codec.encoded_voxels import from_records, to_records
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import CodecError, GaussLiteError, InvalidInputError, MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import (
    VoxelBatch,
    VoxelGrid,
    group_by_voxel,
    merge_batches,
    select_keys,
    select_voxels,
    tiles_of,
)
from gausslite.fusion.change_log import ChangeLog, VoxelLog
from gausslite.fusion.frames import FrameAlignment
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import Preferred, VoteResult, union_maps
from gausslite.fusion.vote_input import SLICE_VOXELS, VoteInput

# no agent can have an empty id
REFINEMENT = "", "refined-map"
"""Owner and name of the stored refinement."""


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap:
    """The result of a refinement, the fused revision it started from, and the agents whose keyframes shaped it."""

    batch: VoxelBatch
    revision: int
    sources: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredRefinement:
    """A refined map without the voxels that have changed, and a hash of the vote's winner in every unchanged voxel.

    After a restart, the hashes tell which voxels have changed since. voted_keys are ascending.
    """

    batch: VoxelBatch
    voted_keys: Int64[ndarray, " v"]
    winner_hashes: UInt64[ndarray, " v"]  # of the vote when it was refined
    sources: tuple[str, ...]  # the agents whose keyframes shaped it

    def without(self, changed: Int64[ndarray, " c"]) -> StoredRefinement:
        """Return the refinement without these voxels, which changed since it started."""
        unchanged = ~np.isin(self.voted_keys, changed)
        batch = select_voxels(self.batch, ~np.isin(self.batch.keys, changed))
        return StoredRefinement(batch, self.voted_keys[unchanged], self.winner_hashes[unchanged], self.sources)

    def changed_voxels(self, vote: VoteResult) -> Int64[ndarray, " c"]:
        """Return the voxels of the vote that have another winner, or another update of it, than in the refinement."""
        _, stored, now = np.intersect1d(self.voted_keys, vote.keys, assume_unique=True, return_indices=True)
        changed = np.ones(len(vote), np.bool_)
        changed[now] = self.winner_hashes[stored] != _winner_hashes(vote)[now]
        return vote.keys[changed]

    def without_removed(self, vote: VoteResult) -> VoxelBatch:
        """Return the refined voxels without those that have left the vote since."""
        removed = np.setdiff1d(self.voted_keys, vote.keys, assume_unique=True)
        return select_voxels(self.batch, ~np.isin(self.batch.keys, removed))


def save_refinement(store: FusionStore, stored: StoredRefinement) -> None:
    """Replace the store's refinement. Raises StorageError."""
    batch = stored.batch
    columns = {
        "keys": batch.keys,
        "kappa_sums": batch.kappa_sums,
        "counts": batch.counts,
        "records": np.frombuffer(to_records(batch.gaussians).tobytes(), np.uint8),
        "voted_keys": stored.voted_keys,
        "winner_hashes": stored.winner_hashes,
        "sources": np.frombuffer(json.dumps(stored.sources).encode(), np.uint8),
    }
    store.save_record(*REFINEMENT, save({name: np.ascontiguousarray(column) for name, column in columns.items()}))


def load_refinement(store: FusionStore) -> StoredRefinement | None:
    """Return the store's refinement, None without one. Raises CodecError, StorageError."""
    data = store.find_record(*REFINEMENT)
    if not data:
        return None
    try:
        columns = load(data)
        gaussians = from_records(columns["records"].tobytes())
        batch = VoxelBatch(columns["keys"], columns["kappa_sums"], columns["counts"], gaussians)
        # one that an earlier version stored may be of any agent's keyframes
        sources = tuple(map(str, json.loads(columns["sources"].tobytes()))) if "sources" in columns else ()
        return StoredRefinement(batch, columns["voted_keys"], columns["winner_hashes"], sources)
    except (SafetensorError, KeyError, ValueError, GaussLiteError) as error:
        raise CodecError(f"stored refinement: expected its arrays, got other bytes ({error})") from error


def _winner_hashes(vote: VoteResult) -> UInt64[ndarray, " v"]:
    winners = vote.winners
    names = np.array([zlib.crc32(name.encode()) for name in winners.agents], np.uint64)
    numbers = (winners.scores[name] for name in ("update_seqs", "kappa_sums", "counts"))
    return hash_columns(names[winners.agent_index], *numbers)


class MapLayer(StrEnum):
    """A map that watchers can follow; REFINED shows the vote in voxels that changed after the latest refinement."""

    VOTE = "vote"
    REFINED = "refined"


@dataclass(frozen=True, slots=True, eq=False)
class WonVoxels:
    """Voxels of a layer with their Gaussians, and the keys that each agent wins in the vote."""

    batch: VoxelBatch
    keys_by_winner: Mapping[str, Sequence[int]]  # ascending

    def of(self, agent_id: str) -> VoxelBatch:
        """Return the voxels that this agent wins."""
        return select_keys(self.batch, np.array(self.keys_by_winner.get(agent_id, ()), np.int64))

    def without(self, agent_id: str) -> WonVoxels:
        """Return the voxels that this agent does not win."""
        own = np.array(self.keys_by_winner.get(agent_id, ()), np.int64)
        return WonVoxels(
            select_voxels(self.batch, ~np.isin(self.batch.keys, own)),
            {name: keys for name, keys in self.keys_by_winner.items() if name != agent_id},
        )


@dataclass(frozen=True, slots=True, eq=False)
class FusedMapChanges:
    """The voxels of a layer that changed up to `revision`, and the keys of those that became empty."""

    revision: int
    won: WonVoxels
    removed: Int64[ndarray, " e"]  # voxels that have no winner any more


class FusedMapLayers:
    """Owns what the vote reads, the change logs and the refined map. Thread-safe."""

    def __init__(
        self,
        votes: VoteInput,
        grid: VoxelGrid,
        first_revision: int,
        max_removed_voxels: int,
        stored: StoredRefinement | None = None,
    ) -> None:
        """stored: the latest refinement from before a restart."""
        # below the engine's; held for a message, or a tile or a slice of a map
        self._lock = Lock()
        self._votes, self._grid = votes, grid
        self._change_log = ChangeLog(first_revision, max_removed_voxels)
        self._refined: RefinedMap | None = None
        vote = votes.rank()
        self._change_log.load(vote)
        # until the first refinement, the refined layer is the vote
        self._voted_log = self._refined_log = self._change_log.voxels
        if stored is not None:
            self._refined_log = VoxelLog(first_revision, max_removed_voxels)
            self._refined_log.record(self._restore_refined(stored, vote), np.zeros(0, np.int64))

    def revision(self, layer: MapLayer = MapLayer.VOTE) -> int:
        """Return the layer's revision; it increases with every change. It does not wait for the lock."""
        return self._log_of(layer).revision

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

    def update(self, stored: Mapping[str, Int64[ndarray, " _"]]) -> dict[str, GaussLiteError]:
        """Vote on these voxels of each agent, which the store has or has no longer, as one revision.

        Returns the errors of the agents whose voxels could not be read; these are left out.
        """
        changed: dict[str, Int64[ndarray, " _"]] = {}
        failed: dict[str, GaussLiteError] = {}
        with self._lock:
            for agent_id, keys in stored.items():
                try:
                    changed[agent_id] = self._votes.move(agent_id, keys)
                except GaussLiteError as error:
                    # one damaged map must not stop the team
                    failed[agent_id], changed[agent_id] = error, self._votes.leave_out(agent_id, keys)
            self._record(changed)
        return failed

    def prefer(self, preferred: Preferred) -> None:
        """Let these maps win their voxels from now on, slice by slice, also after a restart. Raises StorageError."""
        with self._lock:
            keys = self._votes.prefer(preferred)
        for start in range(0, len(keys), SLICE_VOXELS):
            with self._lock:
                self._record(dict.fromkeys(self._votes.agents(), keys[start : start + SLICE_VOXELS]))

    def set_frame(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Read the agent's updates in this frame from now on; `update` moves what is stored."""
        with self._lock:
            self._votes.set_frame(agent_id, alignment)

    def moved_bytes(self, agent_id: str) -> int:
        """Return the memory that an agent's voxels take here as they are in another frame."""
        with self._lock:
            return self._votes.memory_bytes(agent_id)

    def begin_map(self, agent_id: str, moved: Sequence[str], dropped: Sequence[str]) -> str:
        """Begin another map of an agent; as FusionStore.begin_map. Raises StorageError."""
        with self._lock:
            former = self._votes.begin_map(agent_id, moved, dropped)
            self._change_log.rename(agent_id, former)
            return former

    def publish_name(self, name: str, tiles: Sequence[int]) -> None:
        """Record the voxels that a map with a new name wins in these tiles as changed, for the watchers."""
        with self._lock:
            for tile in tiles:
                keys = self._change_log.winners(self._voted_log.keys(tile)).get(name, np.zeros(0, np.int64))
                for log in dict.fromkeys((self._voted_log, self._refined_log)):
                    log.touch(keys)

    def remove_agent(self, name: str) -> None:
        """Vote without a map, of which the store has nothing any more."""
        with self._lock:
            self._record({name: self._votes.remove_agent(name)})
            self._change_log.forget(name)

    def _record(self, changed_keys: Mapping[str, Int64[ndarray, " _"]]) -> None:
        """Record that what the vote reads changed in these voxels of each agent, with one vote on all of them."""
        if not changed_keys:
            return
        # the vote is a pure function of the store: on these voxels it is what a vote on all would give
        vote = self._votes.rank(np.concatenate(list(changed_keys.values())))
        fused_changes = self._change_log.record(changed_keys, vote)
        if self._refined_log is not self._voted_log:
            is_present = np.isin(fused_changes, vote.keys)
            was_present = self._refined_log.find(fused_changes)["revisions"] > 0
            self._refined_log.record(fused_changes[is_present], fused_changes[~is_present & was_present])

    def changes(self, since_revision: int = 0, layer: MapLayer = MapLayer.VOTE) -> FusedMapChanges:
        """Return the changes of a layer since a revision; the whole map for 0. Raises RevisionGoneError."""
        with self._lock:
            log = self._log_of(layer)
            keys = log.changed_since(since_revision) if since_revision else log.all_keys()
            won = self._won_voxels(layer, keys)
            removed = np.setdiff1d(keys, won.batch.keys) if since_revision else np.zeros(0, np.int64)
            return FusedMapChanges(log.revision, won, removed)

    def voted_map(self, only_agent: str = "") -> VoxelBatch:
        """Return the fused map, or its voxels that one agent wins."""
        if only_agent:
            self._require_contributor(only_agent)
        tiles = self._read_tiles(MapLayer.VOTE)
        return merge_batches(*(won.of(only_agent) if only_agent else won.batch for won in tiles))

    def voted_regions(self) -> tuple[VoxelBatch, dict[str, Int64[ndarray, " k"]]]:
        """Return the fused map, and of each agent with voxels in it those that show a target of its task."""
        tiles = list(self._read_tiles(MapLayer.VOTE))
        batch = merge_batches(*(won.batch for won in tiles))
        of_targets = np.repeat(batch.keys, batch.counts)[batch.gaussians.target != NO_TARGET]
        winners = {name for won in tiles for name in won.keys_by_winner}
        won_keys = {
            name: [key for won in tiles for key in won.keys_by_winner.get(name, ())] for name in sorted(winners)
        }
        return batch, {name: np.intersect1d(np.array(own, np.int64), of_targets) for name, own in won_keys.items()}

    def union_map(self, only_agent: str = "") -> VoxelBatch:
        """Return all agents' Gaussians, or one agent's, tile after tile."""
        if only_agent:
            self._require_contributor(only_agent)
        parts = []
        for tile in self.tiles(MapLayer.VOTE)[1].tolist():
            with self._lock:
                keys = self._voted_log.keys(tile)
                one = {only_agent: self._votes.batch(only_agent, keys)} if only_agent else None
                parts.append(union_maps(one or self._votes.batches(keys)))
        return merge_batches(*parts)

    def show_refined(self, gaussians: Gaussians, revision: int, sources: tuple[str, ...]) -> StoredRefinement:
        """Show the result of a refinement that started from the vote at this revision, one tile after the other.

        sources: the agents whose keyframes shaped it, empty if any may have. Returns it for the store, with voxels that
        have changed since. Raises RevisionGoneError if the change log no longer reaches back.
        """
        refined = RefinedMap(group_by_voxel(gaussians, self._grid), revision, sources)
        own: dict[int, set[int]] = {}
        for key, tile in zip(refined.batch.keys.tolist(), tiles_of(refined.batch.keys).tolist(), strict=True):
            own.setdefault(tile, set()).add(key)
        with self._lock:
            revisions = self._voted_log
            changed = set(revisions.changed_since(revision).tolist())
            if self._refined_log is self._voted_log:
                self._refined_log = self._voted_log.copy()
            self._refined, seen = refined, revisions.revision
            known = {*self._refined_log.tiles().tolist(), *self._voted_log.tiles().tolist()}
        keys, hashes = [np.zeros(0, np.int64)], [np.zeros(0, np.uint64)]
        for tile in sorted(known | own.keys()):
            with self._lock:
                changed.update(revisions.changed_since(seen).tolist())
                seen = revisions.revision
                self._show_tile(tile, own.get(tile, set()), changed)
                vote = self._votes.rank(self._voted_log.keys(tile))
            keys.append(vote.keys)
            hashes.append(_winner_hashes(vote))
        voted = np.concatenate(keys)
        order = np.argsort(voted)
        return StoredRefinement(refined.batch, voted[order], np.concatenate(hashes)[order], sources)

    def is_refined_by(self, agent_id: str) -> bool:
        """Return whether the agent's keyframes shaped the refined map, or may have."""
        return self._refined is not None and agent_id in (self._refined.sources or (agent_id,))

    def drop_refined(self) -> None:
        """Show the vote in the refined layer, one tile after the other."""
        with self._lock:
            self._refined = None
            tiles = {*self._refined_log.tiles().tolist(), *self._voted_log.tiles().tolist()}
        for tile in sorted(tiles):
            with self._lock:
                self._show_tile(tile, set(self._voted_log.keys(tile).tolist()), set())

    def changed_since(self, revision: int) -> Int64[ndarray, " c"]:
        """Return the voxels of the vote that changed or became empty after this revision. Raises RevisionGoneError."""
        with self._lock:
            return self._voted_log.changed_since(revision)

    def refined_map(self) -> VoxelBatch:
        """Return the refined map, with the newer vote in changed voxels. Raises MismatchError before a refinement."""
        if self._refined is None:
            raise MismatchError("refined map: expected a refinement first, got none yet; see `gausslite refine`")
        return merge_batches(*(won.batch for won in self._read_tiles(MapLayer.REFINED)))

    def tiles(self, layer: MapLayer) -> tuple[int, Int64[ndarray, " t"]]:
        """Return the layer's revision and the tiles of its voxels, ascending."""
        with self._lock:
            return self.revision(layer), self._log_of(layer).tiles()

    def tile_revision(self, layer: MapLayer, tile: int) -> int:
        """Return the revision of the last change in a tile."""
        with self._lock:
            return self._log_of(layer).tile_revision(tile)

    def tile(self, layer: MapLayer, tile: int) -> WonVoxels:
        """Return the voxels of a tile as they are now."""
        with self._lock:
            return self._won_voxels(layer, self._log_of(layer).keys(tile))

    def _log_of(self, layer: MapLayer) -> VoxelLog:
        return self._voted_log if layer is MapLayer.VOTE else self._refined_log

    def _read_tiles(self, layer: MapLayer) -> Iterator[WonVoxels]:
        """Yield the tiles of a layer. Messages are served in between, so that later tiles may be newer."""
        yield from (self.tile(layer, tile) for tile in self.tiles(layer)[1].tolist())

    def _won_voxels(self, layer: MapLayer, keys: Int64[ndarray, " k"]) -> WonVoxels:
        voted = keys
        parts = []
        refined = self._refined if layer is MapLayer.REFINED else None
        if refined is not None:
            voted = keys[self._voted_log.find(keys)["revisions"] > refined.revision]
            parts.append(select_keys(refined.batch, np.setdiff1d(keys, voted)))
        parts += [self._votes.batch(name, own) for name, own in self._change_log.winners(voted).items()]
        batch = merge_batches(*parts)
        # a commit may have stored a tombstone that is not recorded yet; it follows as a change
        batch = select_voxels(batch, batch.counts > 0)
        winners = self._change_log.winners(batch.keys)
        return WonVoxels(batch, {name: own.tolist() for name, own in winners.items()})

    def _restore_refined(self, stored: StoredRefinement, vote: VoteResult) -> Int64[ndarray, " k"]:
        """Show a refinement from before a restart; returns the voxels of the refined layer."""
        changed = stored.changed_voxels(vote)
        self._refined = RefinedMap(stored.without_removed(vote), self._voted_log.revision, stored.sources)
        # a later revision than the refinement's: these voxels show the vote
        self._voted_log.touch(changed)
        return np.union1d(self._refined.batch.keys, changed)

    def _show_tile(self, tile: int, refined: set[int], changed: set[int]) -> None:
        """Record a tile of the refined layer; changed: the voxels that show the vote."""
        before = set(self._refined_log.keys(tile).tolist())
        shown, removed = sorted(refined - changed), sorted(before - refined - changed)
        self._refined_log.record(np.array(shown, np.int64), np.array(removed, np.int64))

    def _require_contributor(self, agent_id: str) -> None:
        agents = self._votes.agents()
        if agent_id not in agents:
            expected = ", ".join(map(quote_name, agents[:8])) or "no agents yet"
            raise InvalidInputError(f"agent_id: expected a contributor ({expected}), got {quote_name(agent_id)}")
