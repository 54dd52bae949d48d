"""The uplink's reaction to each answer of a server, and to every loss of messages."""

from typing import Any

import numpy as np
import pytest
from few_examples import few_examples
from fusion_running import RunningServer, make_batch
from hypothesis import given
from hypothesis import strategies as st
from serving import serving
from uplink_running import WAIT_S, ScriptedServer, accepted, expected_kappas, rejected, scripted, stored_kappas, uplink

from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.server import Service


def test_a_server_that_lost_its_store_gets_every_voxel_again() -> None:
    answers = iter([accepted(), SessionUnknownError("gone"), accepted()])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.enqueue(make_batch({1: [5], 2: [7]}))
        assert link.drain(WAIT_S)
        link.enqueue(make_batch({3: [1]}))
        assert link.drain(WAIT_S)
        assert link.counters().joins == 2
    assert server.subsets[-1].keys.tolist() == make_batch({1: [5], 2: [7], 3: [1]}).keys.tolist()
    assert server.joined == [True, False]
    assert server.revisions == sorted(set(server.revisions))
    assert server.revisions[0] > 100


def test_a_broken_connection_is_retried() -> None:
    answers = iter([UnavailableError("draining"), GaussLiteError("a bug"), accepted()])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        assert link.counters().connected
    assert len(server.subsets) == 3


def test_an_error_and_its_end_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    answers = iter([*[UnavailableError("draining")] * 3, accepted(), UnavailableError("draining"), accepted()])
    caplog.set_level("INFO", logger="gausslite.wire.uplink")
    with scripted(lambda *_: next(answers)) as (_, address), uplink(address) as link:
        for voxel in (1, 2):
            link.enqueue(make_batch({voxel: [5]}))
            assert link.drain(WAIT_S)
    again = f"uplink: fusion server {address} accepts updates again"
    assert [record.getMessage() for record in caplog.records] == ["uplink: draining; retrying", again] * 2


def test_a_damaged_subset_is_sent_once_more_and_then_dropped() -> None:
    answers = iter([rejected("CHECKSUM"), rejected("CHECKSUM")])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        assert link.counters().subsets_rejected == 1
    np.testing.assert_array_equal(server.subsets[0].gaussians.means_m, server.subsets[1].gaussians.means_m)


@pytest.mark.parametrize("answer", [InvalidInputError("no such codec"), None])
def test_updates_that_cannot_be_stored_are_dropped(answer: GaussLiteError | None) -> None:
    answers = iter([] if answer is None else [answer])
    bad = make_batch({1: [5]})
    if answer is None:
        bad.gaussians.rgb[0] = np.nan
    with scripted(lambda *_: next(answers, accepted())) as (server, address), uplink(address) as link:
        link.enqueue(bad)
        assert link.drain(WAIT_S)
        assert link.counters().subsets_rejected == 1
        link.enqueue(make_batch({2: [5]}))
        assert link.drain(WAIT_S)
    assert server.subsets[-1].keys.tolist() == make_batch({2: [5]}).keys.tolist()


def test_a_rejected_subset_is_dropped_and_the_next_is_sent() -> None:
    answers = iter([rejected("INVALID_INPUT"), accepted()])
    with scripted(lambda *_: next(answers)) as (_, address), uplink(address) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        link.enqueue(make_batch({2: [5]}))
        assert link.drain(WAIT_S)
        counters = link.counters()
    assert (counters.subsets_rejected, counters.voxels_sent) == (1, 1)


FULL = [rejected("QUOTA"), rejected("STORAGE"), QuotaError("full"), StorageError("full")]


@pytest.mark.parametrize("exhausted", FULL)
def test_a_full_server_gets_smaller_messages_later(exhausted: pb.SubsetOutcome | GaussLiteError) -> None:
    answers = iter([exhausted])
    cells = {cell: [1] * 5000 for cell in range(8)}
    with scripted(lambda *_: next(answers, accepted())) as (server, address), uplink(address) as link:
        link.enqueue(make_batch(cells))
        assert link.drain(WAIT_S)
    assert [len(subset) for subset in server.subsets] == [8, 4, 4]
    assert sorted(set(server.revisions)) == server.revisions


@pytest.mark.parametrize("final", [MismatchError("another grid"), NotPermittedError("not you")])
def test_an_error_that_only_the_operator_can_fix_stops_the_uplink(final: GaussLiteError) -> None:
    with scripted(lambda *_: final) as (server, address), uplink(address) as link:
        link.enqueue(make_batch({1: [5]}))
        assert not link.drain(WAIT_S)
        assert link.counters().stopped_because == str(final)
        link.enqueue(make_batch({2: [5]}))
        assert not link.drain(WAIT_S)
        assert link.counters().voxels_waiting == 2
    assert len(server.subsets) == 1


def test_the_server_refuses_another_grid(fusion: RunningServer) -> None:
    with uplink(fusion.client.address, grid=VoxelGrid(0.2)) as link:
        link.enqueue(make_batch({}))
        empty = np.zeros(1, np.uint64), np.zeros(1, np.uint32), make_batch({}).gaussians
        link.enqueue(VoxelBatch(VoxelGrid(0.2).keys(np.zeros((1, 3), np.float32)), *empty))
        assert not link.drain(WAIT_S)
        assert "0.2" in link.counters().stopped_because


class FlakyServer(ScriptedServer):
    """Stores what comes, but sometimes loses the message, the ack, or everything."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__(self._store_or_fail)
        self.store = SqliteStore()
        self._faults = iter(faults)

    async def ContributeSubsets(self, request_iterator: Any, context: Any) -> Any:
        async for request in request_iterator:
            fault = next(self._faults, "none")
            if fault == "message lost":
                raise UnavailableError("cut")
            subset, _ = decode_subset(request.subset)
            if fault == "memory lost":
                self.store = SqliteStore()
                raise SessionUnknownError("restarted")
            put = self.store.put(subset)
            if fault == "ack lost":
                raise UnavailableError("cut")
            status = pb.SUBSET_STATUS_ACCEPTED if len(put.accepted) else pb.SUBSET_STATUS_STALE
            outcome = pb.SubsetOutcome(sequence=request.sequence, status=status)
            yield pb.ContributeSubsetsResponse(acknowledged=request.sequence, outcomes=[outcome])

    def _store_or_fail(self, *_: object) -> pb.SubsetOutcome:
        raise AssertionError


FAULTS = st.lists(st.sampled_from(["none", "message lost", "ack lost", "memory lost"]), max_size=4)
ENQUEUED_BATCHES = st.lists(
    st.dictionaries(st.integers(0, 5), st.lists(st.integers(0, 9), max_size=3), max_size=4), min_size=1, max_size=4
)


@given(enqueued=ENQUEUED_BATCHES, faults=FAULTS, together=st.booleans())
@few_examples
def test_after_any_losses_the_server_has_the_latest_updates(
    enqueued: list[dict[int, list[int]]], faults: list[str], together: bool
) -> None:
    server = FlakyServer(faults)
    service = Service(
        "gausslite.v1.FusionService", lambda running: pb_grpc.add_FusionServiceServicer_to_server(server, running)
    )
    with serving([service]) as running, uplink(running.address) as link:
        for voxels in enqueued:
            link.enqueue(make_batch(voxels))
            assert together or link.drain(WAIT_S)
        assert link.drain(WAIT_S)
    assert stored_kappas(server.store) == expected_kappas(*enqueued)
