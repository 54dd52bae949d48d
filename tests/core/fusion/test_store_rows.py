"""The log of rows: whatever is stored, moved, removed and opened again, each voxel has its latest update."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import google_crc32c
import numpy as np
import pytest
from support.sample_batches import make_batch
from test_fusion_stores import OpenStore, make_subset, opener

from gausslite.codec.stored import to_records
from gausslite.codec.stored_voxels import CODES, StoredSubset, StoredVoxels
from gausslite.codec.subset_codec import decode_stored, decode_subset, encode_subset
from gausslite.domain.errors import StorageError
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid
from gausslite.fusion import store_rows
from gausslite.fusion.score_index import voxel_records
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_maintenance import verify

AGENTS = ("ant", "bee", "cat")
Latest = dict[str, dict[int, tuple[int, int, int, bytes]]]


@pytest.fixture(params=["memory", "sqlite", "postgres"])
def open_store(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> OpenStore:
    """Opens a store that moves rows often."""
    monkeypatch.setattr(store_rows, "_SEGMENT_UNITS", 60)
    monkeypatch.setattr(store_rows, "_SPARE_SEGMENTS", 1)
    return opener(request.param, request)


def random_update(rng: np.random.Generator, agent_id: str) -> tuple[StoredSubset, RoiSubset]:
    """A message of a few voxels in several tiles, as codes or exact, and its Gaussians as floats."""
    if rng.random() < 0.3:
        counts = {int(key): int(rng.integers(0, 4)) for key in rng.integers(0, 60, 6)}
        subset = make_subset(agent_id, int(rng.integers(1, 30)), counts, int(rng.integers(1, 4)), int(rng.integers(9)))
        return StoredSubset.exact(subset), subset
    grid = VoxelGrid(float(rng.choice([0.5, 0.25])))
    seq = int(rng.integers(1, 30))
    message = encode_subset(RoiSubset(agent_id, "", seq, seq, make_batch(int(rng.integers(40)), 12, grid)), grid)
    stored = decode_stored(message)[0]
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
        seqs = store.stored(agent_id, batch.keys).update_seqs.tolist()
        assert dict(zip(batch.keys.tolist(), rows_of(batch, seqs), strict=True)) == own
        some = np.array(sorted(own)[::2], np.int64)
        part = store.batch(agent_id, some)
        assert rows_of(part, store.stored(agent_id, part.keys).update_seqs.tolist()) == [own[key] for key in some]


def rows_of(batch: VoxelBatch, seqs: list[int]) -> list[tuple[int, int, int, bytes]]:
    return list(zip(seqs, batch.kappa_sums.tolist(), batch.counts.tolist(), voxel_records(batch), strict=True))


@pytest.mark.parametrize("seed", range(2))
def test_each_voxel_has_its_latest_update_after_any_messages(open_store: OpenStore, seed: int) -> None:
    rng = np.random.default_rng(seed)
    store, latest = open_store(), Latest()
    is_durable = type(store).__name__ != "MemoryStore"
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
    store, stored = open_store(), decode_stored(message)[0]
    keys = stored.voxels.keys.tolist()
    assert store.put_all([stored])[0].accepted.tolist() == keys
    monkeypatch.setattr(StoredVoxels, "batch", Mock(side_effect=AssertionError("decoded")))
    assert store.put_all([stored])[0].stale.tolist() == keys
    store.close()


def test_outdated_rows_are_deleted(open_store: OpenStore) -> None:
    store = open_store()
    log = store._log
    for seq in range(1, 80):
        store.put(make_subset("ant", seq, dict.fromkeys(range(seq % 3, 60, 3), 2), seed=seq))
    held = sum(size for _, size in log._rows.values())
    in_use = sum(2 + 2 for _ in range(60))
    assert held < 4 * in_use + 4 * 60
    store.close()


def old_rows() -> Iterator[tuple[str, int, int, int, int, int, bytes]]:
    """Rows of a voxel each, as earlier releases stored them: codes with a kappa of two bytes, or exact records."""
    grid = VoxelGrid(0.5)
    batch = make_batch(7, 60, grid)
    labels = {"kappa": batch.gaussians.kappa & np.uint32(0xFFFF), "target": batch.gaussians.target % np.int16(127)}
    batch = replace(batch, gaussians=replace(batch.gaussians, **labels))
    for agent_id, is_exact in (("ant", False), ("bee", True)):
        stored = decode_stored(encode_subset(RoiSubset(agent_id, "", 4, 4, batch), grid))[0].voxels
        old_codes = np.dtype([(name, *CODES.fields[name][:1]) for name in CODES.names[:-1]] + [("kappa", "<u2")])
        for place in range(len(stored)):
            voxel = stored.take(np.array([place]))
            if is_exact or len(voxel.gaussians) == 0:
                data = to_records(voxel.batch().gaussians).tobytes()
            else:
                data = np.float64(0.5).tobytes() + voxel.gaussians.astype(old_codes).tobytes()
            key, seq, kappa_sum, count = (int(value) for value in voxel.voxels[0].item())
            head = agent_id.encode() + np.array([key, seq, kappa_sum, count], "<i8").tobytes()
            yield agent_id, key, seq, kappa_sum, count, google_crc32c.extend(google_crc32c.value(head), data), data


OLD_TABLE = """
    agent_id TEXT NOT NULL, voxel {0} NOT NULL, update_seq {0} NOT NULL, kappa_sum {0} NOT NULL, count {0} NOT NULL,
    checksum {0} NOT NULL, gaussians {1} NOT NULL, PRIMARY KEY (agent_id, voxel)
"""


def make_old_sqlite(path: Path) -> None:
    SqliteStore(path).close()
    with sqlite3.connect(path) as db:
        db.execute("DROP TABLE voxel_updates")
        db.execute(f"CREATE TABLE voxel_updates ({OLD_TABLE.format('INTEGER', 'BLOB')})")
        db.executemany("INSERT INTO voxel_updates VALUES (?, ?, ?, ?, ?, ?, ?)", old_rows())
        db.execute("PRAGMA user_version = 6")
    db.close()


def require_converted(store: FusionStore) -> None:
    grid = VoxelGrid(0.5)
    rows = list(old_rows())
    for agent_id in ("ant", "bee"):
        own = [row for row in rows if row[0] == agent_id]
        batch = store.batch(agent_id)
        assert batch.keys.tolist() == [row[1] for row in own]
        assert batch.kappa_sums.tolist() == [row[3] for row in own]
        assert store.stored(agent_id, batch.keys).update_seqs.tolist() == [row[2] for row in own]
        assert voxel_records(batch) == voxel_records(store.batch("bee"))
    exact = [row[6] for row in rows if row[0] == "bee"]
    assert voxel_records(store.batch("ant")) == exact
    assert np.array_equal(grid.keys(batch.gaussians.means_m), np.repeat(batch.keys, batch.counts))


def test_a_file_with_a_row_for_each_voxel_is_converted(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    make_old_sqlite(path)
    with pytest.raises(StorageError, match="a server converts it"):
        verify(path)
    for _ in range(2):
        store = SqliteStore(path)
        require_converted(store)
        store.close()
    assert verify(path).damaged_rows == 0
    assert verify(path).agents == 2


def test_a_damaged_old_file_is_refused_and_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    make_old_sqlite(path)
    with sqlite3.connect(path) as db:
        db.execute("UPDATE voxel_updates SET kappa_sum = kappa_sum + 1 WHERE agent_id = 'ant'")
    db.close()
    for _ in range(2):
        with pytest.raises(StorageError, match="of agent 'ant' is damaged"):
            SqliteStore(path)


def test_a_database_with_a_row_for_each_voxel_is_converted(postgres) -> None:
    psycopg = pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")
    from gausslite.fusion.postgres_store import PostgresStore

    url = postgres.new_database()
    PostgresStore(url).close()
    with psycopg.connect(url, autocommit=True) as db:
        db.execute("DROP TABLE gausslite.voxel_updates")
        db.execute(f"CREATE TABLE gausslite.voxel_updates ({OLD_TABLE.format('BIGINT', 'BYTEA')})")
        db.cursor().executemany(
            "INSERT INTO gausslite.voxel_updates VALUES (%s, %s, %s, %s, %s, %s, %s)", list(old_rows())
        )
        db.execute("UPDATE gausslite.properties SET value = '1' WHERE name = 'schema_version'")
    for _ in range(2):
        store = PostgresStore(url)
        require_converted(store)
        store.close()
