"""The store on Ray: the same content as one store, while a node of the cluster is killed under load."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.ray_cluster import ray_cluster, skip_unless_ray_starts
from test_sharded_store import assert_same_content, subset_from

from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.fusion.memory_store import MemoryStore

ray = pytest.importorskip("ray", reason="the extra `ray` is not installed")
from gausslite.cluster.ray_store import RaySettings, RayStore  # noqa: E402 - needs ray


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Three nodes on this machine; the store connects to the first one, which stays."""
    skip_unless_ray_starts()
    with ray_cluster(3) as cluster:
        yield cluster


def wait_for_standbys(store: RayStore) -> None:
    deadline_s = time.monotonic() + 240
    while not all(state.standby for state in store.states()):
        assert time.monotonic() < deadline_s, store.states()
        time.sleep(0.1)


def node_of(name: str) -> str:
    return str(ray.get(ray.get_actor(name).node_id.remote()))


@pytest.mark.timeout(900)  # Ray starts a dozen processes
def test_a_killed_node_loses_no_acknowledged_update(cluster: Any, tmp_path: Path) -> None:
    settings, one = RaySettings(tmp_path / "store", shards=2, address=cluster.address), MemoryStore()
    store = RayStore(settings)
    wait_for_standbys(store)
    before = store.states()
    for state in before:
        assert node_of(state.primary) != node_of(state.standby)
    with_primaries = {node_of(state.primary) for state in before}
    assert len(with_primaries) == len(before)
    victim = next(node for node in cluster.worker_nodes if node.node_id in with_primaries)
    deadline_s, update_seq = time.monotonic() + 240, 0
    # the processes of a node end some time after it
    while max(position.epoch for position in store.positions()) == 1:
        assert time.monotonic() < deadline_s
        update_seq += 1
        for each in (store, one):
            each.put(subset_from(("ant", update_seq, dict.fromkeys(range(12), 2), update_seq)))
        if update_seq == 4:
            cluster.remove_node(victim, allow_graceful=False)
    assert_same_content(store, one)
    wait_for_standbys(store)
    store.close()
    # a later process of the server finds the actors and their content
    again = RayStore(settings)
    assert_same_content(again, one)
    again.close()


def test_another_number_of_shards_and_a_missing_cluster_are_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "directory.json").write_text("[{}, {}]")
    with pytest.raises(InvalidInputError, match="expected its 2 shards, got 3"):
        RayStore(RaySettings(tmp_path, shards=3))
    with pytest.raises(UnavailableError, match="expected a cluster at"):
        RayStore(RaySettings(tmp_path, shards=2, address="127.0.0.1:1"))
