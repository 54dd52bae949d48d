"""The file of a store: created at once, its log copied; a damaged one is repaired, restored or refused."""

import contextlib
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from unittest.mock import patch

import pytest
from support.sample_batches import random_subset

from gausslite.domain.errors import StorageError
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_operations.store_maintenance import back_up, restore, verify

VOXELS = range(1, 41)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A closed store with 40 voxels, a keyframe and a record."""
    path = tmp_path / "store.sqlite"
    store = SqliteStore(path)
    store.put(random_subset("ant", 7, dict.fromkeys(VOXELS, 3)))
    store.save_keyframe("ant", 1, b"image")
    store.save_record("ant", "objects", b"mug")
    store.close()
    return path


def flip_a_bit(path: Path, table: str, column: str, where: str = "1") -> None:
    """Change one stored value and not its checksum, as bit rot does."""
    with sqlite3.connect(path) as db:
        rowid, data = db.execute(f"SELECT rowid, {column} FROM {table} WHERE {where}").fetchone()
        if isinstance(data, str):
            damaged = "b" + data[1:]
        else:
            damaged = data ^ 4 if isinstance(data, int) else bytes([data[0] ^ 4]) + data[1:]
        db.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (damaged, rowid))
    db.close()


@pytest.mark.parametrize("column", ["number", "agent_id", "checksum", "voxels"])
def test_a_damaged_row_is_refused_with_the_way_out_and_repair_removes_only_it(path: Path, column: str) -> None:
    before = SqliteStore(path)
    incarnation_id = before.incarnation_id
    before.close()
    flip_a_bit(path, "voxel_updates", column, "number = (SELECT max(number) FROM voxel_updates)")
    pytest.raises(StorageError, SqliteStore, path).match(r"is damaged.*restore a backup.*--repair")
    assert verify(path).damaged_rows == 1
    assert verify(path, repair=True).damaged_rows == 1
    assert verify(path).damaged_rows == 0
    store = SqliteStore(path)
    # the last row has the voxels of the last tile
    assert store.batch("ant").keys.tolist() == list(VOXELS)[:31]
    assert store.incarnation_id != incarnation_id
    store.close()


@pytest.mark.parametrize("table", ["keyframes", "records"])
def test_a_damaged_keyframe_or_record_is_not_served(path: Path, table: str) -> None:
    flip_a_bit(path, table, "data")
    with pytest.raises(StorageError, match="is damaged"), closing(SqliteStore(path)) as store:
        store.keyframe("ant", 1)
    assert verify(path, repair=True).damaged_rows == 1
    assert verify(path).damaged_rows == 0


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE keyframes SET part = part + 9; UPDATE keyframes SET part = 11 - part",
        "DELETE FROM keyframes WHERE part = 0",
        "DELETE FROM keyframes WHERE part = 1",
        "UPDATE keyframes SET frame_index = 3",
    ],
)
def test_a_keyframe_with_parts_that_are_missing_or_not_its_own_is_not_served(path: Path, change: str) -> None:
    store = SqliteStore(path)
    store.save_keyframe("ant", 2, bytes(5 << 18))
    store.remove_keyframes("ant", [1])
    with sqlite3.connect(path) as db:
        db.executescript(change)
    db.close()
    index = 3 if "frame_index" in change else 2
    pytest.raises(StorageError, store.keyframe, "ant", index).match(f"keyframe {index} of agent 'ant' is damaged")
    store.close()
    assert verify(path, repair=True).damaged_rows == 1
    report = verify(path)
    assert (report.damaged_rows, report.keyframes) == (0, 0)


def test_repair_keeps_the_rows_of_intact_pages_and_the_file_before(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    with closing(SqliteStore(path)) as store:
        for number in range(60):
            store.put(random_subset("ant", 1 + number, {100 * number: 3}))
    data = bytearray(path.read_bytes())
    with closing(sqlite3.connect(path)) as db:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'voxel_updates'"
        [[root]] = db.execute(query)
    # the third leaf of the table
    leaf = int.from_bytes(data[4096 * (root - 1) + 12 + 2 * 2 :][:2], "big")
    page = int.from_bytes(data[4096 * (root - 1) + leaf :][:4], "big")
    data[4096 * (page - 1) : 4096 * page] = bytes(4096)
    path.write_bytes(data)
    for read in (SqliteStore, verify):
        pytest.raises(StorageError, read, path).match(r"--repair")
    report = verify(path, repair=True)
    assert (tmp_path / "store.sqlite.replaced-1").read_bytes() == bytes(data)
    assert report.replaced.endswith("store.sqlite.replaced-1")
    with closing(SqliteStore(path)) as store:
        kept = store.batch("ant").keys.tolist()
    assert 40 < len(kept) < 60
    assert {0, 5900} < set(kept)


@pytest.mark.parametrize("change", ["DELETE FROM properties", "UPDATE properties SET value = 'x'"])
def test_a_store_without_its_properties_is_one_clear_line(path: Path, change: str) -> None:
    with sqlite3.connect(path) as db:
        db.execute(change)
    db.close()
    for read in (SqliteStore, verify):
        pytest.raises(StorageError, read, path).match("expected its properties, got damaged ones; restore a backup")
    verify(path, repair=True)
    with closing(SqliteStore(path)) as store:
        assert store.batch("ant").keys.tolist() == list(VOXELS)


def test_a_store_in_a_read_only_place_is_verified_and_backed_up_with_its_log(tmp_path: Path) -> None:
    path, place = tmp_path / "store.sqlite", tmp_path / "read-only"
    place.mkdir()
    with closing(SqliteStore(path)) as store:
        store.put(random_subset("ant", 1, {11: 2}))
        for each in tmp_path.glob("store.sqlite*"):
            shutil.copy(each, place / each.name)
    (place / "store.sqlite-shm").unlink()
    before = sorted(each.name for each in place.iterdir())
    for each in (*place.iterdir(), place):
        each.chmod(each.stat().st_mode & ~0o222)
    # root may write everywhere
    with patch("os.access", side_effect=lambda own, _: own == tmp_path):
        assert verify(place / path.name).voxels == 1
        assert back_up(place / path.name, tmp_path / "backup").voxels == 1
    assert sorted(each.name for each in place.iterdir()) == before
    place.chmod(0o700)


@pytest.mark.parametrize("is_database", [False, True])
def test_an_emptied_file_is_refused(path: Path, is_database: bool) -> None:
    path.write_bytes(b"")
    if is_database:
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA journal_mode = WAL")
        assert path.stat().st_size > 0
    pytest.raises(StorageError, SqliteStore, path).match("got an empty file; restore a backup")


def test_a_torn_log_is_told_and_cut_at_the_last_whole_message_when_it_is_repaired(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    store = SqliteStore(path)
    for update_seq in range(1, 6):
        store.put(random_subset("ant", update_seq, {update_seq: 30}))
    files = {each.name: each.read_bytes() for each in tmp_path.iterdir()}
    incarnation_id = store.incarnation_id
    store.close()
    for cut in (1, 3000, 9000):
        folder = tmp_path / str(cut)
        folder.mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data[:-cut] if name.endswith("-wal") else data)
        (folder / "store.sqlite-shm").unlink()
        for read in (SqliteStore, verify, lambda path, own=folder: back_up(path, own / "copy")):
            with pytest.raises(StorageError, match=r"expected commit 6 of .*, got commit \d of .*--repair"):
                read(folder / "store.sqlite")
        verify(folder / "store.sqlite", repair=True)
        torn = SqliteStore(folder / "store.sqlite")
        assert torn.incarnation_id != incarnation_id
        highest = torn.totals("ant").highest_update_seq
        # the agents compare this number with what was acknowledged, and send again what is missing
        assert highest < 5
        assert torn.batch("ant").keys.tolist() == list(range(1, highest + 1))
        torn.close()


def test_a_backup_of_a_running_store_is_restored_as_another_incarnation(tmp_path: Path) -> None:
    path, backup = tmp_path / "store.sqlite", tmp_path / "backup.sqlite"
    store = SqliteStore(path)
    store.put(random_subset("ant", 1, {11: 2}))
    assert back_up(path, backup).voxels == 1
    pytest.raises(StorageError, back_up, path, backup).match("the file exists")
    store.put(random_subset("ant", 2, {22: 2}))
    pytest.raises(StorageError, restore, backup, path).match("in use by another server")
    incarnation_id = store.incarnation_id
    store.close()
    report, replaced = restore(backup, path)
    assert report.gaussians == 2
    assert verify(replaced).voxels == 2
    restored = SqliteStore(path)
    assert restored.batch("ant").keys.tolist() == [11]
    assert restored.incarnation_id != incarnation_id
    restored.close()


def test_a_damaged_backup_replaces_nothing(path: Path, tmp_path: Path) -> None:
    backup = tmp_path / "backup.sqlite"
    back_up(path, backup)
    flip_a_bit(backup, "voxel_updates", "voxels")
    pytest.raises(StorageError, restore, backup, path).match("1 damaged")
    assert verify(path).voxels == len(VOXELS)


def test_a_server_killed_while_it_creates_its_store_leaves_a_name_that_can_be_opened(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    for step in ("connect", "renew_incarnation", "storage_errors"):
        stopped = patch(f"gausslite.fusion.sqlite_store.{step}", side_effect=KeyboardInterrupt)
        with stopped, pytest.raises(KeyboardInterrupt):
            SqliteStore(path)
        assert not path.exists()
    store = SqliteStore(path)
    # the file says what it is without its log
    alone = tmp_path / "alone.sqlite"
    alone.write_bytes(path.read_bytes())
    SqliteStore(alone).close()
    store.close()


def test_the_log_is_copied_into_the_file_beside_the_commits_and_begins_anew(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    with patch("gausslite.fusion.sqlite_store._CHECKPOINT_PERIOD_S", 0.01), closing(SqliteStore(path)) as store:
        written = 0
        # below what a commit itself would copy
        while written < 200 << 20:
            store.save_keyframe("ant", 1, bytes(1 << 20))
            written += 1 << 20
            if path.with_name("store.sqlite-wal").stat().st_size < written:
                break
        else:
            pytest.fail("the log has never begun anew")
        store.save_keyframe("ant", 2, b"last")
    with closing(SqliteStore(path)) as store:
        assert (store.keyframe("ant", 1), store.keyframe("ant", 2)) == (bytes(1 << 20), b"last")
