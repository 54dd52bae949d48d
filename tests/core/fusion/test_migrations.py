"""Stores of earlier schemas, as their releases wrote them (`stores/`), are brought forward when they are opened."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from absent_package import remove_package
from opened_stores import OpenStore
from support.sample_batches import random_subset

from gausslite.domain.errors import MissingPluginError, StorageError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState, FrameAlignments
from gausslite.fusion.limits import FusionSettings, MissionConfig, SessionRecord
from gausslite.fusion.sqlite_store import SCHEMA_VERSION, SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite_operations.migrations import STEPS
from gausslite_operations.store_maintenance import back_up, restore, verify

DUMPS = {path.stem: path for path in (Path(__file__).parent / "stores").glob("*.sql")}
EARLIER = range(SCHEMA_VERSION - len(STEPS), SCHEMA_VERSION)


def sqlite_of(dump: str, path: Path) -> Path:
    with closing(sqlite3.connect(path)) as db:
        db.executescript(DUMPS[dump].read_text(encoding="utf-8"))
    return path


def postgres_of(dump: str, request: pytest.FixtureRequest) -> OpenStore:
    url = request.getfixturevalue("postgres").new_database()
    import psycopg

    from gausslite_cluster.postgres_store import PostgresStore

    with psycopg.connect(url, autocommit=True) as db:
        db.execute(DUMPS[dump].read_text(encoding="utf-8"))
    return lambda: PostgresStore(url)


def require_content(store: FusionStore) -> None:
    """What was written into each of the dumped stores is there, and the engine takes it over."""
    assert store.mission_config() == MissionConfig("rescue", "site", 0.1)
    assert store.sessions() == (SessionRecord("c0ffee", "ant"),)
    assert store.find_record("ant", "join-token") == bytes(4)
    assert (store.keyframe("ant", 5), store.keyframe("bee", 0)) == (b"an image", b"")
    assert store.keyframe_sizes() == {"ant": {5: 8}, "bee": {0: 0}}
    for subset in (random_subset("ant", 7, {1: 2, 2: 1, 40: 1}), random_subset("bee", 3, {2: 1, 41: 0})):
        batch = store.batch(subset.agent_id)
        assert batch.keys.tolist() == subset.batch.keys.tolist()
        assert batch.gaussians.means_m.tobytes() == subset.batch.gaussians.means_m.tobytes()
    assert store.incarnation_id.startswith("a5" * 16)
    assert FrameAlignments(store, are_compared=True).get("ant").state is AlignmentState.CORRECTED
    FusionEngine(store, FusionSettings())


def test_a_store_of_each_schema_is_held() -> None:
    assert {f"sqlite-{version}" for version in (*EARLIER, SCHEMA_VERSION)} <= DUMPS.keys()
    assert len(DUMPS) == 2 * (len(STEPS) + 1)


@pytest.mark.parametrize("dump", sorted(DUMPS))
def test_an_earlier_store_is_brought_forward_when_it_is_opened(
    dump: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if dump.startswith("postgres"):
        opened = postgres_of(dump, request)
    else:
        path = sqlite_of(dump, tmp_path / "store.sqlite")
        opened = lambda: SqliteStore(path)  # noqa: E731
    # the second time, nothing is left to do
    for _ in range(2):
        with closing(opened()) as store:
            require_content(store)
            store.save_keyframe("ant", 6, b"new")
            store.remove_keyframes("ant", [6])


@pytest.mark.parametrize("version", EARLIER)
def test_the_file_before_is_kept_and_a_failed_step_changes_nothing(
    version: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = sqlite_of(f"sqlite-{version}", tmp_path / "store.sqlite")

    def fail(_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr("gausslite_operations.migrations.STEPS", (*STEPS[:-1], fail))
        pytest.raises(StorageError, SqliteStore, path).match("no space left")
    for reader in (verify, lambda own: back_up(own, tmp_path / "copy")):
        with pytest.raises(StorageError, match="of an earlier schema; a server that opens it brings it forward"):
            reader(path)
    SqliteStore(path).close()
    assert verify(path).damaged_rows == 0
    # a backup of an earlier release
    kept = path.with_name(f"store.sqlite.schema-{version}")
    assert restore(kept, path)[0].voxels == 5
    with closing(SqliteStore(path)) as store:
        assert store.keyframe("ant", 5) == b"an image"


def test_without_the_package_an_earlier_store_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = sqlite_of(f"sqlite-{EARLIER[0]}", tmp_path / "store.sqlite")
    remove_package(monkeypatch, "gausslite_operations")
    with pytest.raises(MissingPluginError, match=f"version {EARLIER[0]}: needs the package gausslite_operations"):
        SqliteStore(path)
    monkeypatch.undo()
    SqliteStore(path).close()


def test_damage_is_not_hidden_by_a_new_checksum(tmp_path: Path) -> None:
    path = sqlite_of("sqlite-8", tmp_path / "store.sqlite")
    with closing(sqlite3.connect(path)) as db:
        db.executescript("UPDATE keyframes SET data = x'00' WHERE part = 1")
    with closing(SqliteStore(path)) as store, pytest.raises(StorageError, match="keyframe 5 of agent 'ant' is damaged"):
        store.keyframe("ant", 5)


@pytest.mark.parametrize("act", [SqliteStore, verify])
def test_an_older_schema_is_one_clear_line(tmp_path: Path, act: Callable[[Path], object]) -> None:
    path = sqlite_of(f"sqlite-{SCHEMA_VERSION}", tmp_path / "store.sqlite")
    with closing(sqlite3.connect(path)) as db:
        db.execute(f"PRAGMA user_version = {EARLIER[0] - 1}")
    with pytest.raises(
        StorageError, match=rf"version {EARLIER[0]} to {SCHEMA_VERSION}, got {EARLIER[0] - 1} of"
    ) as caught:
        act(path)
    assert "\n" not in str(caught.value)
