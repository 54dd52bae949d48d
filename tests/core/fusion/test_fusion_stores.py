"""One suite for every store (updates, sessions, mission), then the properties of a durable store."""

import itertools
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest
from opened_stores import OpenStore, opener
from support.sample_batches import make_batch, random_subset

from gausslite.codec.encoded_voxels import EncodedSubset, to_records
from gausslite.codec.subset_codec import decode_subset, encode_subset
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.domain.voxels import RoiSubset, VoxelGrid, gather_rows, select_keys
from gausslite.fusion.keyframe_pool import KeyframePool
from gausslite.fusion.limits import MissionConfig, Quotas, SessionRecord
from gausslite.fusion.score_index import AgentTotals
from gausslite.fusion.sqlite_store import SCHEMA_VERSION, SqliteStore
from gausslite.fusion.store import FusionStore

KEYS = (11, 22, 33)


@pytest.fixture(params=["memory", "sqlite", "postgres"])
def store(request: pytest.FixtureRequest) -> Iterator[FusionStore]:
    store = opener(request.param, request)()
    yield store
    store.close()


@pytest.fixture(params=["sqlite", "postgres"])
def open_durable(request: pytest.FixtureRequest) -> OpenStore:
    return opener(request.param, request)


def test_stored_updates_are_read_back(store: FusionStore) -> None:
    message = random_subset("ant", 1, {11: 2, 22: 0, 33: 5})
    outcome = store.put(message)
    assert outcome.accepted.tolist() == list(KEYS)
    assert outcome.stale.tolist() == []
    batch = store.batch("ant")
    assert batch.keys.tolist() == list(KEYS)
    assert batch.counts.tolist() == [2, 0, 5]
    assert batch.gaussians.means_m.tobytes() == message.batch.gaussians.means_m.tobytes()
    assert batch.gaussians.active.tolist() == message.batch.gaussians.active.tolist()
    assert store.agents() == ("ant",)


def test_received_updates_are_stored_compactly_and_read_back_exactly(store: FusionStore) -> None:
    grid = VoxelGrid(0.05)
    store.set_mission_config(MissionConfig("m", "map", grid.size_m))
    message, _ = decode_subset(encode_subset(RoiSubset("ant", "session", 1, 1, make_batch(0, 60, grid)), grid))
    store.put(message)
    batch = store.batch("ant")
    assert to_records(batch.gaussians).tobytes() == to_records(message.batch.gaussians).tobytes()
    assert batch.kappa_sums.tolist() == message.batch.kappa_sums.tolist()
    # the same content again is no change, in its decoded form too
    assert store.put(message).accepted.tolist() == []


def test_the_highest_update_seq_wins(store: FusionStore) -> None:
    store.put(random_subset("ant", 5, {11: 2, 22: 2}))
    assert store.put(random_subset("ant", 5, {11: 2, 22: 2})).stale.tolist() == [11, 22]
    assert store.put(random_subset("ant", 4, {11: 4})).stale.tolist() == [11]
    later = store.put(random_subset("ant", 6, {11: 1, 33: 1}))
    assert later.accepted.tolist() == [11, 33]
    assert store.batch("ant").counts.tolist() == [1, 2, 1]
    assert store.totals("ant") == AgentTotals(3, 3, 4, 4, 6)
    assert store.totals("bee") == AgentTotals()


@pytest.mark.parametrize("contents", list(itertools.permutations([(2, 0), (4, 0), (4, 1)])))
def test_of_equal_update_seqs_the_larger_content_wins_in_every_order(
    store: FusionStore, contents: list[tuple[int, int]]
) -> None:
    messages = {content: random_subset("ant", 5, {11: content[0]}, seed=content[1]) for content in contents}
    for content in contents:
        store.put(messages[content])
    largest = max(messages[4, seed].batch.gaussians.means_m[0, 0].tobytes() for seed in (0, 1))
    assert store.batch("ant").gaussians.means_m[0, 0].tobytes() == largest
    assert all(store.put(message).accepted.tolist() == [] for message in messages.values())


def test_messages_of_several_agents_are_stored_together(store: FusionStore) -> None:
    subsets = [random_subset(name, 1, {11: 2, 22: index}) for index, name in enumerate(("ant", "bee"))]
    messages = list(map(EncodedSubset.exact, subsets))
    assert [each.accepted.tolist() for each in store.put_all(messages)] == [[11, 22]] * 2
    assert [each.stale.tolist() for each in store.put_all(messages)] == [[11, 22]] * 2
    assert store.scores().scores["counts"].tolist() == [2, 0, 2, 1]
    with pytest.raises(InvalidInputError):
        store.put_all([EncodedSubset.exact(random_subset(*own, {33: 1})) for own in (("ant", 2), ("bee", 2**63))])
    assert 33 not in store.scores().scores["keys"]


def test_a_tombstone_is_kept_and_makes_older_updates_stale(store: FusionStore) -> None:
    store.put(random_subset("ant", 2, {11: 0}))
    assert store.put(random_subset("ant", 1, {11: 3})).stale.tolist() == [11]
    assert store.batch("ant").counts.tolist() == [0]


def test_agents_do_not_change_each_others_data(store: FusionStore) -> None:
    store.put(random_subset("ant", 9, {11: 2}))
    store.put(random_subset("bee", 1, {11: 1, 22: 1}))
    scores = store.scores()
    assert scores.agents == ("ant", "bee")
    assert scores.agent_index.tolist() == [0, 1, 1]
    assert scores.scores["keys"].tolist() == [11, 11, 22]
    assert scores.scores["update_seqs"].tolist() == [9, 1, 1]
    assert scores.scores["counts"].tolist() == [2, 1, 1]
    assert store.remove_agent("ant").tolist() == [11]
    assert store.agents() == ("bee",)
    assert len(store.batch("ant")) == 0
    assert store.remove_agent("nobody").tolist() == []


def test_reading_some_voxels_equals_selecting_from_all(store: FusionStore) -> None:
    store.put(random_subset("ant", 1, {11: 2, 22: 3, 33: 0}))
    store.put(random_subset("bee", 1, {22: 1}))
    keys = np.array([33, 22, 99, 22], np.int64)
    for agent_id, batch in store.batches(keys).items():
        expected = select_keys(store.batch(agent_id), keys)
        assert batch.keys.tolist() == expected.keys.tolist()
        assert batch.gaussians.means_m.tobytes() == expected.gaussians.means_m.tobytes()
    assert store.scores(keys).scores["keys"].tolist() == [22, 33, 22]
    assert len(store.scores(np.zeros(0, np.int64))) == 0


def test_an_empty_message_changes_nothing(store: FusionStore) -> None:
    assert len(store.put(random_subset("ant", 1, {})).accepted) == 0
    assert store.agents() == ()


def test_a_message_with_too_large_an_update_seq_is_refused_completely(store: FusionStore) -> None:
    pytest.raises(InvalidInputError, store.put, random_subset("ant", 2**63, {11: 1})).match("update_seq")
    assert store.agents() == ()


def test_an_agent_has_one_session_and_the_mission_config_is_stored(store: FusionStore) -> None:
    assert store.mission_config() is None
    mission_config = MissionConfig("mission", "world", 0.1)
    store.set_mission_config(mission_config)
    assert store.mission_config() == mission_config
    store.save_session(SessionRecord("one", "ant"))
    store.save_session(SessionRecord("two", "bee"))
    store.save_session(SessionRecord("three", "ant"))
    assert store.sessions() == (SessionRecord("three", "ant"), SessionRecord("two", "bee"))
    store.end_session("three")
    store.end_session("three")
    assert store.sessions() == (SessionRecord("two", "bee"),)


def test_threads_can_put_concurrently(store: FusionStore) -> None:
    def put_updates(agent_id: str) -> None:
        for update_seq in range(20):
            store.put(random_subset(agent_id, update_seq, {11: 1, 22: update_seq % 3}))

    threads = [Thread(target=put_updates, args=(name,)) for name in ("ant", "bee", "cat")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.scores().scores["update_seqs"].tolist() == [19] * 6


def test_keyframes_and_records_are_stored_and_leave_with_their_agent(store: FusionStore) -> None:
    for index in (3, 5, 5, 8):
        store.save_keyframe("ant", index, bytes(index))
    store.save_keyframe("bee", 5, b"")
    store.save_record("ant", "objects", b"early")
    store.save_record("ant", "objects", b"late")
    store.save_record("bee", "objects", b"")
    assert store.keyframe_sizes() == {"ant": {3: 3, 5: 5, 8: 8}, "bee": {5: 0}}
    assert (store.keyframe("ant", 5), store.keyframe("ant", 6)) == (bytes(5), b"")
    assert store.records("objects") == {"ant": b"late", "bee": b""}
    store.remove_keyframes("ant", [3, 8, 9])
    assert store.keyframe_sizes() == {"ant": {5: 5}, "bee": {5: 0}}
    store.remove_agent("ant")
    assert (store.keyframe_sizes(), store.records("objects")) == ({"bee": {5: 0}}, {"bee": b""})


def test_a_large_keyframe_takes_several_transactions_and_replaces_the_earlier_one_with_the_last(
    store: FusionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    large, seen = bytes(range(256)) * 5000, []

    def write_between(_: float) -> None:
        seen.append((store.keyframe("ant", 1), store.keyframe_sizes()))
        store.put(random_subset("bee", len(seen), {11: 1}))

    monkeypatch.setattr("gausslite.fusion.store.time", SimpleNamespace(monotonic=time.monotonic, sleep=write_between))
    store.save_keyframe("ant", 1, b"small")
    store.save_keyframe("ant", 1, large)
    assert seen == [(b"small", {"ant": {1: 5}})] * 2
    assert store.totals("bee").highest_update_seq == 2
    assert (store.keyframe("ant", 1), store.keyframe_sizes()) == (large, {"ant": {1: len(large)}})
    store.save_keyframe("ant", 1, b"small")
    assert (store.keyframe("ant", 1), store.keyframe_sizes()) == (b"small", {"ant": {1: 5}})


def test_a_keyframe_whose_transactions_are_done_twice_is_the_same(
    store: FusionStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = store._write
    # as after a connection that was lost during the commit
    monkeypatch.setattr(store, "_write", lambda work: (write(work), write(work)))
    for data in (b"small", bytes(range(256)) * 5000, bytes(range(255)) * 3000, b"last"):
        store.save_keyframe("ant", 1, data)
        assert (store.keyframe("ant", 1), store.keyframe_sizes()) == (data, {"ant": {1: len(data)}})


def test_a_keyframe_that_was_cut_leaves_the_earlier_one_and_takes_no_space(
    open_durable: OpenStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(store: FusionStore, stop: BaseException) -> None:
        def stop_between(_: float) -> None:
            raise stop

        monkeypatch.setattr(
            "gausslite.fusion.store.time", SimpleNamespace(monotonic=time.monotonic, sleep=stop_between)
        )
        pytest.raises(type(stop), store.save_keyframe, "ant", 1, bytes(1 << 20))

    store = open_durable()
    store.save_keyframe("ant", 1, b"small")
    # a refused part, then a process that ends
    write(store, StorageError("full"))
    assert unfinished(store) == 0
    write(store, KeyboardInterrupt())
    assert unfinished(store) == 1
    store.close()
    again = open_durable()
    pool = KeyframePool(again, Quotas())
    assert (unfinished(again), pool.indices("ant"), pool.find("ant")) == (0, (1,), b"small")
    again.close()


def unfinished(store: FusionStore) -> int:
    return len(store._read("SELECT 1 FROM keyframes WHERE parts > 1"))


def test_a_reopened_store_has_the_same_content(open_durable: OpenStore) -> None:
    store = open_durable()
    store.put(random_subset("ant", 3, {11: 2}))
    store.save_session(SessionRecord("one", "ant"))
    store.set_mission_config(MissionConfig("m", "w", 0.1))
    store.save_keyframe("ant", 4, b"image")
    incarnation_id = store.incarnation_id
    store.close()
    again = open_durable()
    assert again.batch("ant").counts.tolist() == [2]
    assert again.totals("ant") == AgentTotals(1, 1, 2, 2, 3)
    assert again.sessions() == (SessionRecord("one", "ant"),)
    assert again.mission_config() == MissionConfig("m", "w", 0.1)
    assert again.keyframe("ant", 4) == b"image"
    assert again.incarnation_id == incarnation_id
    again.close()


CHILD = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from sample_batches import random_subset
from gausslite.fusion.sqlite_store import SqliteStore
store = SqliteStore(Path(sys.argv[1]))
for revision in range(1, 1_000_000):
    store.put(random_subset("ant", revision, {11: 3, 100 + revision: 2}, seed=revision))
    print(revision, flush=True)
"""


def test_acknowledged_updates_survive_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    folder = Path(__file__).parents[2] / "support"
    child = subprocess.Popen([sys.executable, "-c", CHILD, path, folder], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    acknowledged = 0
    for line in child.stdout:
        acknowledged = int(line)
        if acknowledged >= 12:
            child.send_signal(signal.SIGKILL)
            break
    acknowledged = max([acknowledged, *(int(line) for line in child.stdout if line.endswith("\n"))])
    child.stdout.close()
    child.wait()
    store = SqliteStore(path)
    batch = store.batch("ant")
    assert set(range(101, 101 + acknowledged)) <= set(batch.keys.tolist())
    assert store.totals("ant").highest_update_seq in (acknowledged, acknowledged + 1)
    assert batch.counts.tolist()[0] == 3
    store.close()


def _damaged(path: Path) -> None:
    store = SqliteStore(path)
    store.put(random_subset("ant", 1, dict.fromkeys(range(60), 40)))
    store.close()
    data = bytearray(path.read_bytes())
    data[4096 : len(data) // 2] = bytes(len(data) // 2 - 4096)
    path.write_bytes(data)


def _execute(path: Path, statement: str) -> None:
    with sqlite3.connect(path) as db:
        db.execute(statement)
    db.close()


def _newer_schema(path: Path) -> None:
    SqliteStore(path).close()
    _execute(path, "PRAGMA user_version = 77")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda path: path.write_bytes(b"no database at all, only text " * 40),
            "expected an undamaged GaussLite store",
        ),
        (lambda path: _execute(path, "CREATE TABLE songs (title TEXT)"), "another program's"),
        (_damaged, "undamaged"),
        (_newer_schema, f"to {SCHEMA_VERSION}, got 77"),
    ],
)
def test_a_foreign_damaged_or_newer_file_is_one_clear_error(
    tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "store.sqlite"
    spoil(path)
    with pytest.raises(StorageError, match=message) as caught:
        SqliteStore(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unwritable_folder_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be opened"):
        SqliteStore(tmp_path / "no" / "such" / "folder" / "store.sqlite")
    pytest.raises(StorageError, SqliteStore, tmp_path)


def test_a_second_server_on_the_same_store_is_refused(open_durable: OpenStore) -> None:
    first = open_durable()
    with pytest.raises(StorageError, match="in use by another server") as caught:
        open_durable()
    assert "\n" not in str(caught.value)
    first.close()
    open_durable().close()


def test_links_do_not_let_a_second_server_open_the_store(tmp_path: Path) -> None:
    path, symbolic, hard = tmp_path / "store.sqlite", tmp_path / "other" / "s", tmp_path / "hard.sqlite"
    symbolic.parent.mkdir()
    symbolic.symlink_to(path)
    # the first one begins behind the link
    first = SqliteStore(symbolic)
    first.put(random_subset("ant", 1, {11: 3}))
    for name in (path, symbolic):
        pytest.raises(StorageError, SqliteStore, name).match("in use by another server")
    os.link(path, hard)
    for name in (path, symbolic, hard):
        pytest.raises(StorageError, SqliteStore, name).match(r"expected a file with one name, got 2 \(hard links\)")
    hard.unlink()
    first.close()
    second = SqliteStore(path)
    assert second.agents() == ("ant",)
    second.close()


def test_a_full_disk_refuses_the_message_and_keeps_earlier_ones(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite", max_bytes=200_000)
    store.put(random_subset("ant", 1, {11: 3}))
    pytest.raises(StorageError, store.put, random_subset("ant", 2, {11: 1, 22: 10_000})).match("no space left")
    assert store.batch("ant").counts.tolist() == [3]
    store.put(random_subset("ant", 3, {11: 2}))
    assert store.batch("ant").counts.tolist() == [2]
    store.close()


def test_gather_rows_returns_every_run() -> None:
    rows = gather_rows(np.array([5, 0, 9]), np.array([2, 0, 3], np.uint32))
    assert rows.tolist() == [5, 6, 9, 10, 11]
