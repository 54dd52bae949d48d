"""The log of rows: whatever is stored, moved, removed and opened again, each voxel has its latest update."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from opened_stores import OpenStore, opener
from support.sample_batches import make_batch, random_subset

from gausslite.codec.encoded_voxels import EncodedSubset, EncodedVoxels
from gausslite.codec.subset_codec import decode_subset, encode_subset, unpack_subset
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import TILE_VOXELS, RoiSubset, VoxelBatch, VoxelGrid
from gausslite.fusion import update_log
from gausslite.fusion.score_index import voxel_records
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore

AGENTS = ("ant", "bee", "cat")
Latest = dict[str, dict[int, tuple[int, int, int, bytes]]]


@pytest.fixture(params=["memory", "sqlite", "postgres"])
def open_store(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> OpenStore:
    """Opens a store that moves rows often."""
    monkeypatch.setattr(update_log, "_SPARE_UNITS", 60)
    return opener(request.param, request)


def random_update(rng: np.random.Generator, agent_id: str) -> tuple[EncodedSubset, RoiSubset]:
    """A message of a few voxels in several tiles, as codes or exact, and its Gaussians as floats."""
    if rng.random() < 0.3:
        counts = {int(key): int(rng.integers(0, 4)) for key in rng.integers(0, 60, 6)}
        subset = random_subset(
            agent_id, int(rng.integers(1, 30)), counts, int(rng.integers(1, 4)), int(rng.integers(9))
        )
        return EncodedSubset.exact(subset), subset
    grid = VoxelGrid(float(rng.choice([0.5, 0.25])))
    seq = int(rng.integers(1, 30))
    message = encode_subset(RoiSubset(agent_id, "", seq, seq, make_batch(int(rng.integers(40)), 12, grid)), grid)
    stored = unpack_subset(message)[0]
    subset = decode_subset(message)[0]
    sums = replace(subset.batch, kappa_sums=stored.voxels.batch().kappa_sums)
    return stored, replace(subset, batch=sums)


def put_in_model(latest: Latest, subset: RoiSubset) -> list[int]:
    """Keep the larger update of each voxel; returns the accepted keys."""
    own, batch = latest.setdefault(subset.agent_id, {}), subset.batch
    accepted = []
    totals = zip(batch.keys.tolist(), batch.kappa_sums.tolist(), batch.counts.tolist(), strict=True)
    for (key, kappa_sum, count), records in zip(totals, voxel_records(batch), strict=True):
        update = subset.update_seq, kappa_sum, count, records
        if key not in own or update > own[key]:
            own[key] = update
            accepted.append(key)
    return accepted


def require_latest(store: FusionStore, latest: Latest) -> None:
    batches = store.batches()
    assert set(batches) == {agent_id for agent_id, own in latest.items() if own}
    for agent_id, batch in batches.items():
        own = latest[agent_id]
        scores = store.scores_of(agent_id, batch.keys)
        kept, computed = store.digests(agent_id), TileDigests.of(batch.keys, scores["update_seqs"])
        assert (kept.tiles.tolist(), kept.hashes.tolist()) == (computed.tiles.tolist(), computed.hashes.tolist())
        seqs = store.scores_of(agent_id, batch.keys)["update_seqs"].tolist()
        assert dict(zip(batch.keys.tolist(), rows_of(batch, seqs), strict=True)) == own
        some = np.array(sorted(own)[::2], np.int64)
        part = store.batch(agent_id, some)
        assert rows_of(part, store.scores_of(agent_id, part.keys)["update_seqs"].tolist()) == [own[key] for key in some]


def rows_of(batch: VoxelBatch, seqs: list[int]) -> list[tuple[int, int, int, bytes]]:
    return list(zip(seqs, batch.kappa_sums.tolist(), batch.counts.tolist(), voxel_records(batch), strict=True))


@pytest.mark.parametrize("seed", range(2))
def test_each_voxel_has_its_latest_update_after_any_messages(open_store: OpenStore, seed: int) -> None:
    rng = np.random.default_rng(seed)
    store, latest = open_store(), Latest()
    is_durable = type(store).__name__ != "SqliteStore"
    for step in range(40):
        group = [random_update(rng, name) for name in rng.permutation(AGENTS)[: rng.integers(1, 4)].tolist()]
        outcomes = store.put_all([stored for stored, _ in group])
        for outcome, (_, subset) in zip(outcomes, group, strict=True):
            assert outcome.accepted.tolist() == put_in_model(latest, subset)
            assert sorted([*outcome.accepted.tolist(), *outcome.stale.tolist()]) == subset.batch.keys.tolist()
        if step % 15 == 10:
            agent_id = str(rng.choice(AGENTS))
            assert store.remove_agent(agent_id).tolist() == sorted(latest.pop(agent_id, {}))
        if step % 10 == 9:
            require_latest(store, latest)
        if is_durable and step % 20 == 15:
            store.close()
            store = open_store()
            require_latest(store, latest)
    store.close()


def test_a_duplicate_is_found_without_decoding_its_gaussians(
    open_store: OpenStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = VoxelGrid(0.5)
    message = encode_subset(RoiSubset("ant", "", 3, 3, make_batch(5, 40, grid)), grid)
    store, stored = open_store(), unpack_subset(message)[0]
    keys = stored.voxels.keys.tolist()
    assert store.put_all([stored])[0].accepted.tolist() == keys
    monkeypatch.setattr(EncodedVoxels, "batch", Mock(side_effect=AssertionError("decoded")))
    assert store.put_all([stored])[0].stale.tolist() == keys
    store.close()


def test_outdated_rows_are_deleted(open_store: OpenStore) -> None:
    store = open_store()
    log = store._log
    for seq in range(1, 80):
        store.put(random_subset("ant", seq, dict.fromkeys(range(seq % 3, 60, 3), 2), seed=seq))
    held = int(log.index._maps["ant"].tiles.select()[1]["written"].sum())
    in_use = sum(2 + 2 for _ in range(60))
    assert held < 4 * in_use + 4 * 60
    store.close()


def test_a_message_rewrites_in_proportion_to_its_own_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(update_log, "_SPARE_UNITS", 60)
    store = SqliteStore()
    read = Mock(wraps=store._read_rows)
    monkeypatch.setattr(store, "_read_rows", read)
    for seq in range(1, 100):
        # one voxel of three units in each of 20 tiles, which are all outdated at once
        store.put(random_subset("ant", seq, dict.fromkeys(range(0, 20 * TILE_VOXELS, TILE_VOXELS), 1)))
    rows_of_a_tile = 60 // 3 + 2
    assert max(len(call.args[0]) for call in read.mock_calls) <= (60 + 4 * 20 * 3) // 3 + 2 * rows_of_a_tile
    ((held,),) = store._read("SELECT count(*) FROM voxel_updates")
    assert held < 2 * 20 * rows_of_a_tile
