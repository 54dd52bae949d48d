"""Fair queues of updates and group commits: no agent waits for another one's large messages."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_fusion_properties import assert_same_batch
from test_fusion_stores import make_subset

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, tombstones
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.store import MissionConfig, PutOutcome
from gausslite.fusion.updates import SLICE_VOXELS, PendingUpdate, UpdateQueue
from gausslite.fusion.vote import fuse

ANY = MissionConfig("", "", 0.10)


def many_tombstones(agent_id: str, voxels: int) -> StoredSubset:
    return StoredSubset.exact(RoiSubset(agent_id, "", 1, 1, tombstones(np.arange(voxels, dtype=np.int64))))


def served(queue: UpdateQueue, max_voxels: int) -> list[str]:
    """Take one group, store nothing of it, and return its agents."""
    group = queue.take(max_voxels)
    for update in group:
        part = update.next_slice().voxels
        queue.put_back(update, update.add_outcome(PutOutcome(part.keys, part.keys[:0])))
    return [update.subset.agent_id for update in group]


def test_a_large_message_does_not_delay_the_messages_of_other_agents() -> None:
    queue = UpdateQueue()
    for _ in range(3):
        queue.add(PendingUpdate("", many_tombstones("hog", 50 * SLICE_VOXELS)))
    order = served(queue, 1)
    for _ in range(20):
        for agent_id in ("ant", "bee"):
            queue.add(PendingUpdate("", StoredSubset.exact(make_subset(agent_id, 1, {11: 1}))))
        order += served(queue, 1) + served(queue, 1) + served(queue, 1)
    assert order.count("ant") == order.count("bee") == 20
    # the small messages together cost less than one slice, so the hog gets the rest
    assert max(np.diff([i for i, name in enumerate(order) if name == "ant"])) <= 4


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 3 * SLICE_VOXELS)), max_size=12), st.integers(1, 9000))
@settings(max_examples=30)
def test_every_message_is_served_once_and_in_its_agents_order(messages: list[tuple[str, int]], group: int) -> None:
    queue = UpdateQueue()
    updates = [PendingUpdate("", many_tombstones(name, voxels)) for name, voxels in messages]
    for update in updates:
        queue.add(update)
    done: list[PendingUpdate] = []
    while queue.has_waiting:
        taken = queue.take(group)
        assert len({update.subset.agent_id for update in taken}) == len(taken)
        for update in taken:
            part = update.next_slice().voxels
            is_done = update.add_outcome(PutOutcome(part.keys, part.keys[:0]))
            done += [update] * is_done
            queue.put_back(update, is_done)
    for name in "abc":
        assert [u for u in done if u.subset.agent_id == name] == [u for u in updates if u.subset.agent_id == name]
    assert all(u.outcome().accepted.tolist() == u.subset.voxels.keys.tolist() for u in done)


def test_an_agent_that_does_not_wait_for_acknowledgements_is_refused() -> None:
    queue = UpdateQueue()
    for _ in range(64):
        queue.add(PendingUpdate("", many_tombstones("hog", 1)))
    with pytest.raises(UnavailableError, match="wait for their acknowledgement"):
        queue.add(PendingUpdate("", many_tombstones("hog", 1)))


class CountingStore(MemoryStore):
    """Counts the transactions; refuses those of the agent `refused`."""

    def __init__(self, refused: str = "") -> None:
        super().__init__()
        self.groups: list[int] = []
        self._refused = refused

    def put_all(self, subsets: list[StoredSubset]) -> list[PutOutcome]:
        self.groups.append(len(subsets))
        if any(subset.agent_id == self._refused for subset in subsets):
            raise StorageError("full")
        return super().put_all(subsets)


def test_messages_of_many_agents_share_one_commit_and_a_refused_one_fails_alone() -> None:
    store = CountingStore(refused="cat")
    engine = FusionEngine(store, FusionSettings())
    agents = ["ant", "bee", "cat", "dog"]
    sessions = {name: engine.join(name, ANY).session.session_id for name in agents}
    futures = {
        name: engine.enqueue_update(sessions[name], StoredSubset.exact(make_subset(name, 1, {11: 2})), engine.grid)
        for name in agents
    }
    engine.commit_updates()
    assert store.groups[0] == 4
    assert isinstance(futures.pop("cat").exception(), StorageError)
    assert all(future.result().accepted.tolist() == [11] for future in futures.values())
    assert store.agents() == ("ant", "bee", "dog")


def test_concurrent_agents_and_an_eviction_give_the_map_of_the_stored_updates() -> None:
    store = MemoryStore()
    engine = FusionEngine(store, FusionSettings())

    def contribute(agent_id: str) -> None:
        session_id = engine.join(agent_id, ANY).session.session_id
        for update_seq in range(1, 30):
            engine.contribute(
                session_id, make_subset(agent_id, update_seq, {11: 1 + update_seq % 3, 22: 1}), engine.grid
            )

    threads = [threading.Thread(target=contribute, args=(name,)) for name in ("ant", "bee", "cat")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    engine.evict("bee")
    fused = fuse(store.batches())
    assert_same_batch(engine.maps.changes(0).won.batch, fused.batch)
    assert store.agents() == ("ant", "cat")
    assert isinstance(fused.gaussians, Gaussians)
    assert engine.status().fused_gaussians == len(fused.gaussians)
