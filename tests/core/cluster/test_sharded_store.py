"""A sharded store has the content and the outcomes of one store, and a failing shard leaves nothing half counted."""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gausslite.cluster.regions import shard_of_keyframe, shard_of_voxels
from gausslite.cluster.sharded_store import ShardedStore
from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import PutOutcome

GRID = VoxelGrid(0.10)
# in voxels of many tiles, so that every shard has some
KEYS = np.sort(GRID.keys(np.array([[1.7 * i, -2.3 * i, 0.9 * i] for i in range(12)], np.float32)))
Message = tuple[str, int, dict[int, int], int]
MESSAGES = st.lists(
    st.tuples(
        st.sampled_from(["ant", "bee"]),
        st.integers(0, 5),
        st.dictionaries(st.integers(0, len(KEYS) - 1), st.integers(0, 3), max_size=6),
        st.integers(0, 2),
    ),
    max_size=8,
)


def subset_from(message: Message) -> RoiSubset:
    """A message of (agent, update_seq, Gaussians by voxel, seed)."""
    agent_id, update_seq, counts, seed = message
    rows = sorted(counts)
    per_voxel = np.array([counts[row] for row in rows], np.uint32)
    n = int(per_voxel.sum())
    numbers = np.random.default_rng(seed).random((n, 14), np.float32)
    gaussians = Gaussians(
        numbers[:, :3], numbers[:, 3:7], numbers[:, 7:10], numbers[:, 10], numbers[:, 11:14],
        np.arange(n) % 2 == 0, np.arange(n, dtype=np.uint32), np.full(n, -1, np.int16),
    )  # fmt: skip
    ends = np.cumsum(per_voxel)
    sums = [int(gaussians.kappa[end - count : end].sum()) for end, count in zip(ends, per_voxel, strict=True)]
    batch = VoxelBatch(KEYS[rows].astype(np.int64), np.array(sums, np.uint64), per_voxel, gaussians)
    return RoiSubset(agent_id, "session", update_seq, update_seq, batch)


def assert_same_outcomes(a: list[PutOutcome], b: list[PutOutcome]) -> None:
    assert [each.accepted.tolist() for each in a] == [each.accepted.tolist() for each in b]
    assert [each.stale.tolist() for each in a] == [each.stale.tolist() for each in b]


def assert_same_batch(a: VoxelBatch, b: VoxelBatch) -> None:
    assert a.keys.tolist() == b.keys.tolist()
    assert a.kappa_sums.tolist() == b.kappa_sums.tolist()
    assert a.counts.tolist() == b.counts.tolist()
    for each in fields(Gaussians):
        assert getattr(a.gaussians, each.name).tobytes() == getattr(b.gaussians, each.name).tobytes(), each.name


def assert_same_content(a: FusionStore, b: FusionStore) -> None:
    assert a.agents() == b.agents()
    for keys in (None, KEYS[::2].astype(np.int64)):
        x, y = a.scores(keys), b.scores(keys)
        for name in ("agent_index", "keys", "update_seqs", "kappa_sums", "counts"):
            assert getattr(x, name).tolist() == getattr(y, name).tolist(), name
        of_a, of_b = a.batches(keys), b.batches(keys)
        assert sorted(of_a) == sorted(of_b)
        for agent_id in of_a:
            assert_same_batch(of_a[agent_id], of_b[agent_id])
            assert_same_batch(a.batch(agent_id, keys), b.batch(agent_id, keys))
    for agent_id in a.agents():
        assert a.totals(agent_id) == b.totals(agent_id)
        assert a.digests(agent_id).tiles.tolist() == b.digests(agent_id).tiles.tolist()
        assert a.digests(agent_id).hashes.tolist() == b.digests(agent_id).hashes.tolist()
    assert a.keyframe_sizes() == b.keyframe_sizes()


@settings(max_examples=30, deadline=None)
@given(MESSAGES, st.integers(1, 4), st.booleans())
def test_any_number_of_shards_gives_the_same_outcomes_and_content(
    messages: list[Message], shards: int, remove: bool
) -> None:
    one, several = MemoryStore(), ShardedStore([MemoryStore() for _ in range(shards)])
    for message in messages:
        subset = subset_from(message)
        assert_same_outcomes([several.put(subset)], [one.put(subset)])
    if remove:
        assert several.remove_agent("ant").tolist() == one.remove_agent("ant").tolist()
    assert_same_content(several, one)
    several.close()


def test_voxels_and_keyframes_are_spread_over_the_shards() -> None:
    keys = GRID.keys(np.random.default_rng(0).uniform(-20, 20, (20_000, 3)).astype(np.float32))
    shares = np.bincount(shard_of_voxels(keys, 4), minlength=4) / len(keys)
    assert shares.min() > 0.2
    assert {shard_of_keyframe("ant", index, 4) for index in range(40)} == {0, 1, 2, 3}


def test_a_reopened_store_has_the_same_content_and_keyframes(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.sqlite" for number in range(3)]
    first, one = ShardedStore([SqliteStore(path) for path in paths]), MemoryStore()
    for store in (first, one):
        store.put(subset_from(("ant", 1, dict.fromkeys(range(12), 2), 0)))
        for index in range(6):
            store.save_keyframe("ant", index, bytes(index))
        store.remove_keyframes("ant", [1, 4])
    incarnation_id = first.incarnation_id
    first.close()
    again = ShardedStore([SqliteStore(path) for path in paths])
    assert_same_content(again, one)
    assert again.incarnation_id == incarnation_id
    assert again.keyframe("ant", 3) == bytes(3)
    again.close()


class FailingStore(MemoryStore):
    """A store whose disk is full while `is_full` is set."""

    is_full = False

    def put_all(self, subsets: list[RoiSubset]) -> list[PutOutcome]:  # type: ignore[override]
        if self.is_full:
            raise StorageError("no space left")
        return super().put_all(subsets)

    def remove_agent(self, agent_id: str) -> np.ndarray:  # type: ignore[override]
        if self.is_full:
            raise StorageError("refused")
        return super().remove_agent(agent_id)


def test_a_message_that_one_shard_refuses_counts_as_a_whole_when_it_is_sent_again() -> None:
    shards = [FailingStore() for _ in range(3)]
    store, message = ShardedStore(shards), subset_from(("ant", 1, dict.fromkeys(range(12), 2), 0))
    shards[1].is_full = True
    with pytest.raises(StorageError):
        store.put(message)
    assert store.agents() == ()
    shards[1].is_full = False
    assert store.put(message).accepted.tolist() == KEYS.tolist()
    assert store.put(message).stale.tolist() == KEYS.tolist()
    one = MemoryStore()
    one.put(message)
    assert_same_content(store, one)
    store.close()


def test_an_agent_that_one_shard_does_not_delete_is_known_only_there() -> None:
    shards = [FailingStore() for _ in range(3)]
    store, message = ShardedStore(shards), subset_from(("ant", 1, dict.fromkeys(range(12), 2), 0))
    store.put(message)
    shards[1].is_full = True
    with pytest.raises(StorageError):
        store.remove_agent("ant")
    assert store.scores().keys.tolist() == shards[1].scores().keys.tolist()
    shards[1].is_full = False
    assert store.put(message).stale.tolist() == shards[1].scores().keys.tolist()
    assert store.remove_agent("ant").tolist() == KEYS.tolist()
    store.close()


def test_a_store_on_disk_counts_its_transactions() -> None:
    with tempfile.TemporaryDirectory() as folder:
        store = SqliteStore(Path(folder) / "store.sqlite")
        message = subset_from(("ant", 1, {0: 1}, 0))
        store.put(message)
        store.put(message)
        assert store.log_position == 1
        store.save_record("ant", "name", b"")
        store.close()
        again = SqliteStore(Path(folder) / "store.sqlite")
        assert again.log_position == 2
        again.close()
