"""A store whose voxels are spread over several stores ("shards") by region."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from hashlib import sha256
from threading import RLock
from typing import TypeVar

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.cluster.regions import shard_of_keyframe, shard_of_voxels
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.tile_digests import TileDigests
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxel_operations import empty_batch, merge_batches, select_voxels
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.score_index import ScoreIndex, compare_scores, newer_voxels, scores_of, select_scores
from gausslite.fusion.store import FusionStore, require_storable
from gausslite.fusion.store_changes import (
    AgentRemoved,
    ContentReplaced,
    MissionConfigSet,
    SessionEnded,
    SessionSaved,
    StoreChange,
    UpdatesStored,
)
from gausslite.fusion.store_values import AgentTotals, PutOutcome, SessionRecord, StoredScores, VoxelScoreTable

_Result = TypeVar("_Result")


class ShardedStore:
    """A FusionStore over shards, with the same content and outcomes as one store.

    The totals of all updates are here too (ScoreIndex), so only Gaussians are read from the shards. Other servers may
    write to the same shards; `take_changes` counts their updates. The first shard has the records, every shard has the
    sessions (see SessionFence). If a shard fails, `put_all` raises and counts nothing as stored, although other shards
    may have their parts. Sending the messages again gives the same outcome as a first attempt, or reports as stale what
    `take_changes` has counted in between.
    """

    def __init__(self, shards: Sequence[FusionStore]) -> None:
        """Read the totals from all shards. Raises StorageError."""
        self._shards = tuple(shards)
        self._lock, self._index_lock = RLock(), RLock()
        self._threads = ThreadPoolExecutor(len(self._shards), "shard")
        self._index = ScoreIndex()
        self._is_outdated = False
        self._read_totals()

    @property
    def incarnation_id(self) -> str:
        """An id that changes when that of any shard does."""
        ids = "\n".join(self._each(lambda shard: shard.incarnation_id))
        return sha256(ids.encode()).hexdigest()[:32]

    def put(self, subset: RoiSubset) -> PutOutcome:
        """Store one message. Raises InvalidInputError, StorageError."""
        return self.put_all([subset])[0]

    def put_all(self, subsets: Sequence[RoiSubset]) -> list[PutOutcome]:
        """Store messages of different agents; each shard in one transaction. Raises InvalidInputError, StorageError."""
        for subset in subsets:
            require_storable(subset)
        with self._lock:
            masks = [newer_voxels(self._index, subset, self.batch) for subset in subsets]
            newer = [
                replace(subset, batch=select_voxels(subset.batch, mask))
                for subset, mask in zip(subsets, masks, strict=True)
                if mask.any()
            ]
            self._put_newer(newer)
            with self._index_lock:
                for subset in newer:
                    every = np.ones(len(subset.batch), np.bool_)
                    self._index.put(subset.agent_id, subset.batch.keys, scores_of(subset, every))
        return [
            PutOutcome(subset.batch.keys[mask], subset.batch.keys[~mask])
            for subset, mask in zip(subsets, masks, strict=True)
        ]

    def remove_agent(self, agent_id: str) -> Int64[ndarray, " v"]:
        """Delete an agent's updates, keyframes and records; returns the keys of the updates' voxels, ascending."""
        with self._lock:
            try:
                self._each(lambda shard: shard.remove_agent(agent_id))
            except GaussLiteError:
                # some shards have deleted their part, which the index must not claim any more
                self._read_agent(agent_id)
                raise
            with self._index_lock:
                return self._index.remove_agent(agent_id)

    def agents(self) -> tuple[str, ...]:
        """Return the ids of the agents with updates, sorted."""
        return self._index.agents

    def totals(self, agent_id: str) -> AgentTotals:
        """Return the sums over an agent's updates, in constant time; zero for an unknown agent."""
        with self._index_lock:
            return self._index.totals(agent_id)

    def digests(self, agent_id: str) -> TileDigests:
        """Return the digests of an agent's updates (with tombstones); empty for an unknown agent."""
        with self._index_lock:
            return self._index.digests(agent_id)

    def stored(self, agent_id: str, keys: Int64[ndarray, " k"]) -> StoredScores:
        """Return the agent's totals on these voxels, in their order."""
        with self._index_lock:
            return self._index.stored(agent_id, keys)

    def scores(self, keys: Int64[ndarray, " k"] | None = None) -> VoxelScoreTable:
        """Return all agents' totals on these voxels, or on all."""
        with self._index_lock:
            return self._index.scores(keys)

    def batch(self, agent_id: str, keys: Int64[ndarray, " k"] | None = None) -> VoxelBatch:
        """Return an agent's updates (with tombstones) of these voxels, or of all; empty for an unknown agent."""
        if keys is None:
            return merge_batches(*self._each(lambda shard: shard.batch(agent_id)))
        return merge_batches(*self._each_with(keys, lambda shard, own: shard.batch(agent_id, own)))

    def batches(self, keys: Int64[ndarray, " k"] | None = None) -> dict[str, VoxelBatch]:
        """Return the batch of every agent, all read at one instant."""
        # no other writer exists
        with self._lock:
            parts = (
                self._each(lambda shard: shard.batches())
                if keys is None
                else self._each_with(keys, lambda shard, own: shard.batches(own))
            )
            empty = empty_batch()
            return {name: merge_batches(*(part.get(name, empty) for part in parts)) for name in self.agents()}

    def mission_config(self) -> MissionConfig | None:
        """Return the mission's configuration; None before an agent has joined."""
        return self._shards[0].mission_config()

    def set_mission_config(self, mission_config: MissionConfig) -> None:
        """Store the mission's configuration; every shard has it, for the voxel size of its rows."""
        self._each(lambda shard: shard.set_mission_config(mission_config))

    def sessions(self) -> tuple[SessionRecord, ...]:
        """Return all open sessions, sorted by session id."""
        return self._shards[0].sessions()

    def save_session(self, session: SessionRecord) -> None:
        """Store a session; it replaces any other session of the same agent."""
        self._each(lambda shard: shard.save_session(session))

    def end_session(self, session_id: str) -> None:
        """Delete a session, if it exists. The agent's updates stay."""
        self._each(lambda shard: shard.end_session(session_id))

    def save_keyframe(self, agent_id: str, index: int, data: bytes) -> None:
        """Store an encoded keyframe; it replaces the agent's one of this frame index."""
        self._keyframe_shard(agent_id, index).save_keyframe(agent_id, index, data)

    def remove_keyframes(self, agent_id: str, indices: Iterable[int]) -> None:
        """Delete these keyframes of an agent, if they exist."""
        ordered = sorted(indices, key=lambda index: shard_of_keyframe(agent_id, index, len(self._shards)))
        grouped = itertools.groupby(ordered, lambda index: shard_of_keyframe(agent_id, index, len(self._shards)))
        for number, own in grouped:
            self._shards[number].remove_keyframes(agent_id, list(own))

    def keyframe_sizes(self) -> dict[str, dict[int, int]]:
        """Return the number of bytes of each agent's keyframes by frame index."""
        sizes: dict[str, dict[int, int]] = {}
        for part in self._each(lambda shard: shard.keyframe_sizes()):
            for agent_id, own in part.items():
                sizes.setdefault(agent_id, {}).update(own)
        return sizes

    def keyframe(self, agent_id: str, index: int) -> bytes:
        """Return an encoded keyframe; empty if it does not exist."""
        return self._keyframe_shard(agent_id, index).keyframe(agent_id, index)

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        """Store a named record of an agent; it replaces the earlier one."""
        self._shards[0].save_record(agent_id, name, data)

    def records(self, name: str) -> dict[str, bytes]:
        """Return the record of this name of every agent that has one."""
        return self._shards[0].records(name)

    def fetch_changes(self) -> bool:
        """Fetch what other servers have written; returns whether there is anything to take. Raises StorageError."""
        return any(self._each(lambda shard: shard.fetch_changes()))

    def take_changes(self) -> list[StoreChange]:
        """Count the fetched updates in the totals; returns all changes but the updates that were counted already."""
        taken: list[StoreChange] = []
        for number, shard in enumerate(self._shards):
            for change in shard.take_changes():
                match change:
                    case ContentReplaced():
                        self._is_outdated = True
                    case UpdatesStored():
                        taken += self._count(change)
                    case AgentRemoved(agent_id, keys):
                        with self._index_lock:
                            self._index.remove_voxels(agent_id, keys)
                        taken.append(replace(change, has_records=number == 0))
                    case SessionSaved() | SessionEnded() | MissionConfigSet() if number > 0:
                        # the first shard has reported it
                        continue
                    case _:
                        taken.append(change)
        if not self._is_outdated:
            return taken
        self._read_totals()
        self._is_outdated = False
        return [ContentReplaced()]

    def close(self) -> None:
        """Close the shards."""
        self._threads.shutdown(wait=True)
        for shard in self._shards:
            shard.close()

    def _read_totals(self) -> None:
        index = ScoreIndex()
        for table in self._each(lambda shard: shard.scores()):
            _add_all(index, table)
        with self._index_lock:
            self._index = index

    def _count(self, change: UpdatesStored) -> list[StoreChange]:
        """Add the updates that are newer than the known ones to the index; returns those that may have changed."""
        with self._index_lock:
            known = self._index.stored(change.agent_id, change.keys)
            newer, same = compare_scores(change.scores, known)
            self._index.put(change.agent_id, change.keys[newer], select_scores(change.scores, newer))
        # between equal totals the shard keeps the larger content, which the index does not know
        changed = newer if change.is_own else newer | same
        if not changed.any():
            return []
        return [UpdatesStored(change.agent_id, change.keys[changed], select_scores(change.scores, changed))]

    def _read_agent(self, agent_id: str) -> None:
        """Replace the agent's totals by those of the shards, as far as these answer."""
        tables = []
        for shard in self._shards:
            with contextlib.suppress(GaussLiteError):
                tables.append(shard.scores())
        with self._index_lock:
            self._index.remove_agent(agent_id)
            for table in tables:
                _add_all(self._index, table, agent_id)

    def _put_newer(self, subsets: Sequence[RoiSubset]) -> None:
        of_shards: list[list[RoiSubset]] = [[] for _ in self._shards]
        for subset in subsets:
            of_voxels = shard_of_voxels(subset.batch.keys, len(self._shards))
            for number in np.unique(of_voxels).tolist():
                part = select_voxels(subset.batch, of_voxels == number)
                of_shards[number].append(replace(subset, batch=part))
        self._in_parallel(
            [partial(shard.put_all, own) for shard, own in zip(self._shards, of_shards, strict=True) if own]
        )

    def _keyframe_shard(self, agent_id: str, index: int) -> FusionStore:
        return self._shards[shard_of_keyframe(agent_id, index, len(self._shards))]

    def _each(self, read: Callable[[FusionStore], _Result]) -> list[_Result]:
        return self._in_parallel([partial(read, shard) for shard in self._shards])

    def _each_with(
        self, keys: Int64[ndarray, " k"], read: Callable[[FusionStore, Int64[ndarray, " o"]], _Result]
    ) -> list[_Result]:
        """Read from the shards that have one of these voxels."""
        of_voxels = shard_of_voxels(keys, len(self._shards))
        return self._in_parallel(
            [partial(read, self._shards[number], keys[of_voxels == number]) for number in np.unique(of_voxels).tolist()]
        )

    def _in_parallel(self, calls: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Return all results, when all calls have ended. Raises the first error."""
        if len(calls) == 1:
            return [calls[0]()]
        futures = [self._threads.submit(call) for call in calls]
        for future in futures:
            future.exception()
        return [future.result() for future in futures]


def _add_all(index: ScoreIndex, table: VoxelScoreTable, only: str = "") -> None:
    for number, agent_id in enumerate(table.agents):
        if only not in ("", agent_id):
            continue
        own = table.agent_index == number
        index.put(
            agent_id,
            table.keys[own],
            StoredScores(table.update_seqs[own], table.kappa_sums[own], table.counts[own]),
        )
