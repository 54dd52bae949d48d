"""Fair queues of updates and group commits: no agent waits for another one's large messages."""

import threading

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import plain_gaussians
from support.sample_batches import random_subset
from test_fusion_properties import assert_same_batch

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, tombstones
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.update_log import PutOutcome
from gausslite.fusion.updates import SLICE_VOXELS, PendingUpdate, UpdateQueue
from gausslite.fusion.vote import fuse

ANY = MissionConfig("", "", 0.10)


def many_tombstones(agent_id: str, voxels: int) -> EncodedSubset:
    return EncodedSubset.exact(RoiSubset(agent_id, "", 1, 1, tombstones(np.arange(voxels, dtype=np.int64))))


def pending(agent_id: str, message: bytes | EncodedSubset) -> PendingUpdate:
    return PendingUpdate("", agent_id, message)


def encoded(agent_id: str, seq: int, cells: dict[int, int]) -> bytes:
    """A message with this number of Gaussians in cells along x."""
    means = [(0.1 * cell + 0.05, 0.05, 0.05) for cell, count in cells.items() for _ in range(count)]
    batch = group_by_voxel(plain_gaussians(np.array(means).reshape(-1, 3), kappa=1), VoxelGrid(0.1))
    return encode_subset(RoiSubset(agent_id, "", seq, seq, batch), VoxelGrid(0.1))


def served(queue: UpdateQueue, max_voxels: int) -> list[str]:
    """Take one group, store nothing of it, and return its agents."""
    group = queue.take(max_voxels)
    for update in group:
        part = update.next_slice().voxels
        if update.add_outcome(PutOutcome(part.keys, part.keys[:0])):
            update.future.set_result(update.outcome())
        queue.put_back(update)
    return [update.subset.agent_id for update in group]


def test_a_large_message_does_not_delay_the_messages_of_other_agents() -> None:
    queue = UpdateQueue()
    for _ in range(3):
        queue.add(pending("hog", many_tombstones("hog", 50 * SLICE_VOXELS)))
    order = served(queue, 1)
    for _ in range(20):
        for agent_id in ("ant", "bee"):
            queue.add(pending(agent_id, EncodedSubset.exact(random_subset(agent_id, 1, {11: 1}))))
        order += served(queue, 1) + served(queue, 1) + served(queue, 1)
    assert order.count("ant") == order.count("bee") == 20
    # the small messages together cost less than one slice, so the hog gets the rest
    assert max(np.diff([i for i, name in enumerate(order) if name == "ant"])) <= 4


def test_a_small_message_comes_before_the_equal_large_ones_of_many_agents() -> None:
    queue = UpdateQueue()
    for number in range(20):
        for _ in range(3):
            queue.add(pending(f"hog-{number}", many_tombstones(f"hog-{number}", 1000)))
    for turn in range(1, 6):
        for _ in range(turn):
            served(queue, 1)
        queue.add(pending("ant", EncodedSubset.exact(random_subset("ant", turn, {11: 1}))))
        assert served(queue, 1) == ["ant"]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 3 * SLICE_VOXELS)), max_size=12), st.integers(1, 9000))
@few_examples
def test_every_message_is_served_once_and_in_its_agents_order(messages: list[tuple[str, int]], group: int) -> None:
    queue = UpdateQueue()
    updates = [pending(name, many_tombstones(name, voxels)) for name, voxels in messages]
    for update in updates:
        queue.add(update)
    done: list[PendingUpdate] = []
    while taken := queue.take(group):
        assert len({update.subset.agent_id for update in taken}) == len(taken)
        for update in taken:
            part = update.next_slice().voxels
            is_done = update.add_outcome(PutOutcome(part.keys, part.keys[:0]))
            done += [update] * is_done
            if is_done:
                update.future.set_result(update.outcome())
            queue.put_back(update)
    for name in "abc":
        assert [u for u in done if u.subset.agent_id == name] == [u for u in updates if u.subset.agent_id == name]
    assert all(u.outcome().accepted.tolist() == u.subset.voxels.keys.tolist() for u in done)


def test_an_agent_that_does_not_wait_for_acknowledgements_is_refused() -> None:
    queue = UpdateQueue()
    for _ in range(64):
        queue.add(pending("hog", many_tombstones("hog", 1)))
    with pytest.raises(UnavailableError, match="wait for their acknowledgement"):
        queue.add(pending("hog", many_tombstones("hog", 1)))


def test_messages_wait_encoded_and_their_bytes_are_limited() -> None:
    queue = UpdateQueue()
    large = bytes(1 << 20)
    for _ in range(4):
        queue.add(pending("hog", large))
    with pytest.raises(UnavailableError, match=r"agent 'hog': expected at most 64 messages and 4 MiB"):
        queue.add(pending("hog", large))
    for number in range(15):
        for _ in range(4):
            queue.add(pending(f"other-{number}", large))
    pytest.raises(UnavailableError, queue.add, pending("ant", b"small")).match("16 agents have 64 MiB that wait")
    # a message that is taken is decoded, so it makes room for another one
    [taken] = queue.take(1)
    queue.add(pending("ant", b"small"))
    taken.future.set_result(None)
    queue.put_back(taken)


def test_a_message_costs_what_its_header_declares() -> None:
    many = tombstones(np.arange(100_000, dtype=np.int64))
    message = encode_subset(RoiSubset("hog", "", 1, 1, many), VoxelGrid(0.1))
    assert len(message) < 20_000
    assert pending("hog", message).cost > 20 * 100_000
    queue = UpdateQueue()
    queue.add(pending("hog", message))
    queue.add(pending("hog", message))
    for _ in range(20):
        queue.add(pending("ant", encoded("ant", 1, {0: 40})))
    order = []
    while taken := queue.take(1):
        [update] = taken
        order.append(update.agent_id)
        update.future.set_result(None)
        queue.put_back(update)
    # together, the small ones cost less than one that is short but declares much
    assert order == [*["ant"] * 20, "hog", "hog"]


def test_a_late_message_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings())
    session = engine.join("ant", ANY).session
    for seq in (1, 2):
        engine.enqueue_update(session, encoded("ant", seq, {0: 2}))
    for update in engine.queue._pending["ant"]:
        update.queued_s -= 60.0
    engine.commit_updates()
    [line] = [record.getMessage() for record in caplog.records if "late" in record.getMessage()]
    assert line.startswith("messages are late: one of agent ant has waited 6")


class CountingStore(SqliteStore):
    """Counts the transactions; refuses those of the agent `refused`."""

    def __init__(self, refused: str = "") -> None:
        super().__init__()
        self.groups: list[int] = []
        self._refused = refused

    def put_all(self, subsets: list[EncodedSubset]) -> list[PutOutcome]:
        self.groups.append(len(subsets))
        if any(subset.agent_id == self._refused for subset in subsets):
            raise StorageError("full")
        return super().put_all(subsets)


def test_messages_of_many_agents_share_one_commit_and_a_refused_one_fails_alone() -> None:
    store = CountingStore(refused="cat")
    engine = FusionEngine(store, FusionSettings())
    agents = ["ant", "bee", "cat", "dog"]
    sessions = {name: engine.join(name, ANY).session for name in agents}
    futures = {name: engine.enqueue_update(sessions[name], encoded(name, 1, {11: 2})) for name in agents}
    engine.commit_updates()
    assert store.groups[0] == 4
    assert isinstance(futures.pop("cat").exception(), StorageError)
    assert all(len(future.result().accepted) == 1 for future in futures.values())
    assert store.agents() == ("ant", "bee", "dog")


def test_concurrent_agents_and_an_eviction_give_the_map_of_the_stored_updates() -> None:
    store = SqliteStore()
    engine = FusionEngine(store, FusionSettings())

    def contribute(agent_id: str) -> None:
        session_id = engine.join(agent_id, ANY).session.session_id
        for update_seq in range(1, 30):
            engine.contribute(
                session_id, random_subset(agent_id, update_seq, {11: 1 + update_seq % 3, 22: 1}), engine.grid
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
    assert engine.status().fused_gaussians == len(fused.batch.gaussians)
