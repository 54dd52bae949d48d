"""The uplink against real servers: everything arrives, whatever happens on the way."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fusion_team import GRID, team, words
from hypothesis import given, settings
from hypothesis import strategies as st
from serving import serving

from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.subset import VoxelWords
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.fusion.memory import MemoryStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.clients import FusionClient
from gausslite.wire.server import Service
from gausslite.wire.spool import Purpose, Spool
from gausslite.wire.uplink import Uplink
from gausslite.wire.uplink_values import UplinkSettings

EAGER = UplinkSettings(interval_s=0.0, growth_share=0.0, first_backoff_s=0.01)
WAIT_S = 20.0


@contextmanager
def uplink(
    address: str, options: UplinkSettings = EAGER, spool: Path | None = None, grid: VoxelGrid = GRID
) -> Iterator[Uplink]:
    link = Uplink(FusionClient(address), "robot", Spool(spool, "robot", grid), grid, options)
    try:
        yield link
    finally:
        link.close()


def held(store: MemoryStore) -> dict[int, list[int]]:
    """Per voxel the kappas the server holds of the robot."""
    table = store.words("robot")
    return {
        key: table.gaussians.kappa[start:end].tolist()
        for key, start, end in zip(table.keys.tolist(), table.offsets[:-1], table.offsets[1:], strict=True)
    }


def said(*offers: dict[int, list[int]]) -> dict[int, list[int]]:
    """Per voxel what these offers leave behind."""
    last: dict[int, list[int]] = {}
    for offer in offers:
        table = words(offer)
        for key, start, end in zip(table.keys.tolist(), table.offsets[:-1], table.offsets[1:], strict=True):
            last[key] = table.gaussians.kappa[start:end].tolist()
    return last


class ScriptedServer(pb_grpc.FusionServiceServicer):
    """Answers each subset as a script says, and remembers what came."""

    def __init__(self, answer: Callable[[int, VoxelWords], pb.SubsetOutcome | GaussLiteError]) -> None:
        self._answer = answer
        self.joined: list[bool] = []
        self.subsets: list[VoxelWords] = []
        self.messages: list[bytes] = []
        self.revisions: list[int] = []
        self.came = threading.Event()

    async def JoinSession(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        self.joined.append(request.fresh_map)
        return pb.JoinSessionResponse(session_id=f"s{len(self.joined)}", highest_map_revision=100)

    async def ContributeSubsets(self, request_iterator: Any, context: Any) -> Any:
        async for request in request_iterator:
            subset, _ = decode_subset(request.subset)
            self.subsets.append(subset.words)
            self.messages.append(request.subset)
            self.revisions.append(subset.map_revision)
            self.came.set()
            answer = self._answer(len(self.subsets), subset.words)
            if isinstance(answer, GaussLiteError):
                raise answer
            answer.sequence = request.sequence
            yield pb.ContributeSubsetsResponse(acknowledged=request.sequence, outcomes=[answer])


def accepted() -> pb.SubsetOutcome:
    return pb.SubsetOutcome(status=pb.SUBSET_STATUS_ACCEPTED)


def rejected(reason: str) -> pb.SubsetOutcome:
    return pb.SubsetOutcome(status=pb.SUBSET_STATUS_REJECTED, reason=reason, message="scripted")


@contextmanager
def scripted(
    answer: Callable[[int, VoxelWords], pb.SubsetOutcome | GaussLiteError],
) -> Iterator[tuple[ScriptedServer, str]]:
    servicer = ScriptedServer(answer)
    service = Service(
        "gausslite.v1.FusionService",
        lambda server: pb_grpc.add_FusionServiceServicer_to_server(servicer, server),
    )
    with serving([service]) as running:
        yield servicer, running.address


def test_what_was_offered_arrives_the_newest_word_of_each_voxel() -> None:
    store = MemoryStore()
    offers = [{1: [5, 6], 2: [7], 3: [1]}, {2: [], 3: [9, 9, 9]}, {4: [2]}]
    with team(store) as fusion, uplink(fusion.client.address) as link:
        for offer in offers:
            link.offer(words(offer))
        assert link.drain(WAIT_S)
        counters = link.counters()
    assert held(store) == said(*offers)
    assert counters.voxels_sent == 4
    assert counters.voxels_waiting == 0
    assert counters.subsets_rejected == 0
    assert counters.bytes_sent == counters.roi_bytes > 0


def test_handover_is_counted_apart_and_sends_only_what_differs() -> None:
    store = MemoryStore()
    with team(store) as fusion, uplink(fusion.client.address) as link:
        link.offer(words({1: [5], 2: [7]}))
        assert link.drain(WAIT_S)
        before = link.counters()
        link.offer(words({1: [5], 2: [7], 3: [0, 0]}), Purpose.HANDOVER)
        assert link.drain(WAIT_S)
        after = link.counters()
        [agent] = fusion.client.status().agents
    assert held(store).keys() == said({1: [5], 2: [7], 3: [0, 0]}).keys()
    assert after.roi_bytes == before.roi_bytes == agent.roi_bytes
    assert after.handover_bytes == agent.handover_bytes > 0
    assert after.voxels_sent == 2


def test_a_server_that_lost_its_memory_gets_everything_again() -> None:
    answers = iter([accepted(), SessionUnknownError("gone"), accepted()])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.offer(words({1: [5], 2: [7]}))
        assert link.drain(WAIT_S)
        link.offer(words({3: [1]}))
        assert link.drain(WAIT_S)
        assert link.counters().joins == 2
    assert server.subsets[-1].keys.tolist() == words({1: [5], 2: [7], 3: [1]}).keys.tolist()
    assert server.joined == [True, False]
    assert server.revisions == sorted(set(server.revisions))
    assert server.revisions[0] > 100


def test_the_spool_survives_a_restart_of_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    nobody = "127.0.0.1:1"
    with uplink(nobody, spool=path) as link:
        link.offer(words({1: [5], 2: [7]}))
        assert not link.drain(0.0)
    store = MemoryStore()
    with team(store) as fusion, uplink(fusion.client.address, spool=path) as link:
        link.offer(words({2: [8]}))
        assert link.drain(WAIT_S)
    assert held(store) == said({1: [5], 2: [8]})


def test_a_connection_that_breaks_is_tried_again() -> None:
    answers = iter([UnavailableError("draining"), GaussLiteError("a bug"), accepted()])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.offer(words({1: [5]}))
        assert link.drain(WAIT_S)
        assert link.counters().connected
    assert len(server.subsets) == 3


def test_damage_is_sent_once_more_and_then_given_up() -> None:
    answers = iter([rejected("CHECKSUM"), rejected("CHECKSUM")])
    with scripted(lambda *_: next(answers)) as (server, address), uplink(address) as link:
        link.offer(words({1: [5]}))
        assert link.drain(WAIT_S)
        assert link.counters().subsets_rejected == 1
    np.testing.assert_array_equal(server.subsets[0].gaussians.means_m, server.subsets[1].gaussians.means_m)


@pytest.mark.parametrize("answer", [InvalidInputError("no such codec"), None])
def test_words_that_nobody_will_ever_take_are_dropped(answer: GaussLiteError | None) -> None:
    answers = iter([] if answer is None else [answer])
    bad = words({1: [5]})
    if answer is None:
        bad.gaussians.rgb[0] = np.nan
    with scripted(lambda *_: next(answers, accepted())) as (server, address), uplink(address) as link:
        link.offer(bad)
        assert link.drain(WAIT_S)
        assert link.counters().subsets_rejected == 1
        link.offer(words({2: [5]}))
        assert link.drain(WAIT_S)
    assert server.subsets[-1].keys.tolist() == words({2: [5]}).keys.tolist()


def test_a_rejected_subset_is_dropped_and_the_next_goes_on() -> None:
    answers = iter([rejected("INVALID_INPUT"), accepted()])
    with scripted(lambda *_: next(answers)) as (_, address), uplink(address) as link:
        link.offer(words({1: [5]}))
        assert link.drain(WAIT_S)
        link.offer(words({2: [5]}))
        assert link.drain(WAIT_S)
        counters = link.counters()
    assert (counters.subsets_rejected, counters.voxels_sent) == (1, 1)


FULL = [rejected("QUOTA"), rejected("STORAGE"), QuotaError("full"), StorageError("full")]


@pytest.mark.parametrize("exhausted", FULL)
def test_a_full_server_gets_smaller_messages_later(exhausted: pb.SubsetOutcome | GaussLiteError) -> None:
    answers = iter([exhausted])
    cells = {cell: [1] * 5000 for cell in range(8)}
    with scripted(lambda *_: next(answers, accepted())) as (server, address), uplink(address) as link:
        link.offer(words(cells))
        assert link.drain(WAIT_S)
    assert [len(subset) for subset in server.subsets] == [8, 4, 4]
    assert sorted(set(server.revisions)) == server.revisions


@pytest.mark.parametrize("final", [MismatchError("another grid"), NotPermittedError("not you")])
def test_what_only_the_operator_can_mend_stops_the_uplink(final: GaussLiteError) -> None:
    with scripted(lambda *_: final) as (server, address), uplink(address) as link:
        link.offer(words({1: [5]}))
        assert not link.drain(WAIT_S)
        assert link.counters().stopped_because == str(final)
        link.offer(words({2: [5]}))
        assert not link.drain(WAIT_S)
        assert link.counters().voxels_waiting == 2
    assert len(server.subsets) == 1


def test_another_grid_is_told_by_the_real_server() -> None:
    with team() as fusion, uplink(fusion.client.address, grid=VoxelGrid(0.2)) as link:
        link.offer(words({}))
        link.offer(VoxelWords(VoxelGrid(0.2).keys(np.zeros((1, 3), np.float32)), *EMPTY))
        assert not link.drain(WAIT_S)
        assert "0.2" in link.counters().stopped_because


EMPTY = (np.zeros(1, np.uint64), np.zeros(1, np.uint32), words({}).gaussians)


def test_bandwidth_goes_first_to_the_voxels_that_were_trained_most() -> None:
    slow = UplinkSettings(kbps=1.0, interval_s=0.0)
    with scripted(lambda *_: accepted()) as (server, address), uplink(address, slow) as link:
        link.offer(words({cell: [cell] * 40 for cell in range(1, 9)}))
        assert server.came.wait(WAIT_S)
        assert not link.drain(0.0)
        first = server.subsets[0]
    assert first.keys.tolist() == [words({8: [1]}).keys[0]]


def test_small_growth_waits_for_more_or_for_the_end() -> None:
    patient = UplinkSettings(interval_s=0.0, growth_share=0.5)
    with scripted(lambda *_: accepted()) as (server, address), uplink(address, patient) as link:
        link.offer(words({1: [100]}))
        assert link.drain(WAIT_S)
        link.offer(words({1: [101]}))
        link.offer(words({2: [1]}))
        assert link.drain(WAIT_S)
    kappas = [subset.kappa_sums.tolist() for subset in server.subsets]
    assert kappas[0] == [100]
    assert sorted(total for subset in kappas[1:] for total in subset) == [1, 101]


def test_stop_waiting_ends_a_drain() -> None:
    with uplink("127.0.0.1:1") as link:
        link.offer(words({1: [5]}))
        timer = threading.Timer(0.05, link.stop_waiting)
        timer.start()
        assert not link.drain(600.0)
        timer.join()


def test_a_spool_of_someone_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    Spool(path, "robot", GRID).close()
    with pytest.raises(MismatchError, match="'other'"):
        Spool(path, "other", GRID)
    with pytest.raises(MismatchError, match=r"0\.5 m"):
        Spool(path, "robot", VoxelGrid(0.5))
    (tmp_path / "noise").write_bytes(b"noise" * 1000)
    with pytest.raises(StorageError, match="noise"):
        Spool(tmp_path / "noise", "robot", GRID)
    with pytest.raises(StorageError, match="nowhere"):
        Spool(tmp_path / "nowhere" / "spool", "robot", GRID)


@pytest.mark.parametrize("wrong", [{"kbps": 0.0}, {"kbps": float("nan")}, {"interval_s": -1.0}, {"deadline_s": 0.0}])
def test_settings_without_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match="uplink"):
        UplinkSettings(**wrong)  # type: ignore[arg-type]


class FlakyServer(ScriptedServer):
    """Stores what comes, but now and then loses the message, the ack, or everything."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__(self._store_or_fail)
        self.store = MemoryStore()
        self._faults = iter(faults)

    async def ContributeSubsets(self, request_iterator: Any, context: Any) -> Any:
        async for request in request_iterator:
            fault = next(self._faults, "none")
            if fault == "message lost":
                raise UnavailableError("cut")
            subset, _ = decode_subset(request.subset)
            if fault == "memory lost":
                self.store = MemoryStore()
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
OFFERS = st.lists(
    st.dictionaries(st.integers(0, 5), st.lists(st.integers(0, 9), max_size=3), max_size=4), min_size=1, max_size=4
)


@given(offers=OFFERS, faults=FAULTS, together=st.booleans())
@settings(max_examples=25, deadline=None)
def test_whatever_is_lost_on_the_way_the_server_ends_with_the_newest_words(
    offers: list[dict[int, list[int]]], faults: list[str], together: bool
) -> None:
    server = FlakyServer(faults)
    service = Service(
        "gausslite.v1.FusionService",
        lambda running: pb_grpc.add_FusionServiceServicer_to_server(server, running),
    )
    with serving([service]) as running, uplink(running.address) as link:
        for offer in offers:
            link.offer(words(offer))
            assert together or link.drain(WAIT_S)
        assert link.drain(WAIT_S)
    assert held(server.store) == said(*offers)
