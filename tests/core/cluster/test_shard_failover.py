"""A shard loses no acknowledged write, whichever of its replicas fails."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.local_replicas import LocalHosts
from test_sharded_store import KEYS, assert_same_content, subset_from

from gausslite.cluster.replica import EpochError, ShardReplica
from gausslite.cluster.shard_directory import ShardDirectory
from gausslite.cluster.store_calls import LogEntry, LogPosition, StoreCall
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite.fusion.memory_store import MemoryStore


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[LocalHosts]:
    hosts = LocalHosts(tmp_path)
    yield hosts
    hosts.close()


def settle(hosts: LocalHosts) -> None:
    """Wait until every shard has a standby."""
    assert hosts.directory is not None
    deadline_s = time.monotonic() + 30
    while not all(state.standby for state in hosts.directory.states()):
        assert time.monotonic() < deadline_s, hosts.directory.states()
        time.sleep(0.005)


def message(update_seq: int, voxels: int = len(KEYS)) -> StoreCall:
    return StoreCall("put_all", ([subset_from(("ant", update_seq, dict.fromkeys(range(voxels), 2), update_seq))],))


def test_a_killed_primary_is_replaced_by_its_standby(hosts: LocalHosts) -> None:
    store, one = hosts.open_store(2), MemoryStore()
    settle(hosts)
    for update_seq in range(1, 5):
        for each in (store, one):
            each.put(subset_from(("ant", update_seq, dict.fromkeys(range(12), 2), update_seq)))
        state = hosts.directory.states()[update_seq % 2]
        hosts.stop(state.primary)
    assert_same_content(store, one)
    assert min(state.epoch for state in hosts.directory.states()) > 1
    store.close()


def test_a_killed_standby_is_replaced_and_the_new_one_has_everything(hosts: LocalHosts) -> None:
    store, one = hosts.open_store(1), MemoryStore()
    settle(hosts)
    first = hosts.directory.states()[0]
    hosts.stop(first.standby)
    for each in (store, one):
        each.put(subset_from(("ant", 1, dict.fromkeys(range(12), 2), 0)))
    settle(hosts)
    second = hosts.directory.states()[0]
    assert second.primary == first.primary
    assert second.standby not in ("", first.standby)
    hosts.stop(second.primary)
    assert_same_content(store, one)
    assert hosts.directory.states()[0].primary == second.standby
    store.close()


def test_without_a_standby_the_primarys_file_is_opened_again(hosts: LocalHosts) -> None:
    store, one = hosts.open_store(1), MemoryStore()
    settle(hosts)
    state = hosts.directory.states()[0]
    hosts.stop(state.standby)
    for each in (store, one):
        each.put(subset_from(("ant", 1, dict.fromkeys(range(12), 2), 0)))
    hosts.stop(state.primary)
    assert_same_content(store, one)
    store.close()


def test_a_primary_that_was_replaced_acknowledges_nothing(hosts: LocalHosts) -> None:
    store = hosts.open_store(1)
    settle(hosts)
    state = hosts.directory.states()[0]
    old = hosts.running[state.primary]
    # it runs on, but the directory cannot reach it
    hosts.unreachable.add(state.primary)
    store.put(subset_from(("ant", 1, {0: 1}, 0)))
    assert hosts.directory.states()[0].primary != state.primary
    with pytest.raises(EpochError):
        old.call(state.epoch, message(2))
    assert store.scores().update_seqs.tolist() == [1]
    # from now on it does not lead in its own eyes
    assert not old.leads(state.epoch)
    store.close()


def test_a_standby_refuses_entries_of_an_earlier_epoch_and_gaps(tmp_path: Path) -> None:
    replica = ShardReplica(tmp_path / "a.sqlite")
    assert replica.follow(3) == LogPosition(3, 0)
    with pytest.raises(EpochError):
        replica.append(LogEntry(LogPosition(2, 0), message(1)))
    with pytest.raises(InvalidInputError, match="expected the entry after"):
        replica.append(LogEntry(LogPosition(3, 1), message(1)))
    replica.append(LogEntry(LogPosition(3, 0), message(1)))
    with pytest.raises(EpochError):
        replica.call(3, message(2))
    with pytest.raises(EpochError):
        replica.follow(2)
    with pytest.raises(EpochError):
        replica.lead(3, lambda _: True)
    replica.close()


def test_only_methods_of_a_store_can_be_called(tmp_path: Path) -> None:
    replica = ShardReplica(tmp_path / "a.sqlite")
    replica.lead(1, lambda _: True)
    with pytest.raises(InvalidInputError, match="close"):
        replica.call(1, StoreCall("close"))
    replica.close()


def test_writes_during_the_copy_for_a_standby_reach_it(tmp_path: Path) -> None:
    primary = ShardReplica(tmp_path / "a.sqlite")
    primary.lead(1, lambda _: True)
    primary.call(1, message(1, 5))
    primary.copy_to(tmp_path / "b.sqlite")
    primary.call(1, message(2, 7))
    standby = ShardReplica(tmp_path / "b.sqlite")
    assert primary.attach(1, standby) == LogPosition(1, 2)
    primary.call(1, message(3, 3))
    primary.close()
    standby.lead(2, lambda _: True)
    expected = MemoryStore()
    for update_seq, voxels in ((1, 5), (2, 7), (3, 3)):
        expected.put_all(message(update_seq, voxels).arguments[0])
    table = standby.call(2, StoreCall("scores")).result
    assert table.update_seqs.tolist() == expected.scores().update_seqs.tolist()
    standby.close()


def test_a_file_that_is_not_the_copy_cannot_become_the_standby(tmp_path: Path) -> None:
    primary, empty = ShardReplica(tmp_path / "a.sqlite"), ShardReplica(tmp_path / "c.sqlite")
    primary.lead(1, lambda _: True)
    primary.call(1, message(1))
    primary.copy_to(tmp_path / "b.sqlite")
    with pytest.raises(StorageError, match="do all machines see the same folder"):
        primary.attach(1, empty)
    primary.close()
    empty.close()


def test_a_directory_that_crashed_while_a_standby_joined_starts_another(hosts: LocalHosts) -> None:
    store = hosts.open_store(1)
    settle(hosts)
    path = hosts.folder / "directory.json"
    path.write_text(path.read_text().replace('"joining": ""', '"joining": "shard-0-replica-9"'))
    again = ShardDirectory(hosts.folder, 1, hosts)
    assert again.states()[0].joining == ""
    again.close()
    store.close()


def test_the_state_survives_a_restart_of_the_directory(hosts: LocalHosts) -> None:
    store = hosts.open_store(2)
    store.put(subset_from(("ant", 1, dict.fromkeys(range(12), 1), 0)))
    settle(hosts)
    before = hosts.directory.states()
    again = ShardDirectory(hosts.folder, 2, hosts)
    again.check()
    assert again.states() == before
    again.close()
    with pytest.raises(InvalidInputError, match="expected its 2 shards, got 3"):
        ShardDirectory(hosts.folder, 3, hosts)
    (hosts.folder / "directory.json").write_text("{")
    with pytest.raises(StorageError, match="expected the directory of a sharded store"):
        ShardDirectory(hosts.folder, 2, hosts)
    store.close()


def test_without_any_machine_the_failure_is_one_clear_error(hosts: LocalHosts) -> None:
    hosts.fails_to_start = True
    with pytest.raises(StorageError, match="shard 0: no replica can lead: no machine"):
        hosts.open_store(1)


FAULTS = st.tuples(st.integers(0, 1), st.sampled_from(["primary", "standby", "directory", "none"]))


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    faults=st.lists(
        st.tuples(st.integers(0, 1), st.sampled_from(["primary", "standby", "directory", "none"])), max_size=6
    )
)
def test_random_faults_lose_nothing(tmp_path_factory: pytest.TempPathFactory, faults: list[tuple[int, str]]) -> None:
    hosts, one = LocalHosts(tmp_path_factory.mktemp("shards")), MemoryStore()
    store = hosts.open_store(2)
    for update_seq, (shard, fault) in enumerate(faults, start=1):
        for each in (store, one):
            each.put(subset_from(("ant", update_seq, {(update_seq + i) % 12: 1 for i in range(8)}, update_seq)))
        state = hosts.directory.states()[shard]
        if fault == "directory":
            hosts.directory.close()
            store.close()
            store = hosts.open_store(2)
        elif fault != "none":
            hosts.stop(getattr(state, fault))
    assert_same_content(store, one)
    assert np.array_equal(store.scores().keys, one.scores().keys)
    store.close()
    hosts.close()
