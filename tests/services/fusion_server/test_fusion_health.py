"""The health of a fusion server whose store cannot write: NOT_SERVING, and SERVING again when it can."""

import re
import resource
import subprocess
import threading
import urllib.request
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

import grpc
import pytest
from fusion_running import COMMAND, GRID, fusion_server, make_subset, request
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.fusion import traffic
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.traffic import Acknowledgements, StorageProbe
from gausslite.fusion.update_log import PutOutcome
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire import server
from gausslite.wire.clients import FusionClient

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
WAIT_S = 60.0


def watch_health(channel: grpc.Channel, name: str = "") -> Iterator[int]:
    """Yield the health at each change."""
    stream = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(service=name), timeout=WAIT_S)
    return (answer.status for answer in stream)


def check_health(channel: grpc.Channel, name: str) -> int:
    request = health_pb2.HealthCheckRequest(service=name)
    return health_pb2_grpc.HealthStub(channel).Check(request, timeout=WAIT_S).status


@contextmanager
def limited_files(process: subprocess.Popen[bytes], size_bytes: int) -> Iterator[None]:
    """Make every write of the process beyond this size of a file fail, as on a full disk."""
    before = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, before)


def test_health_metric_and_log_follow_a_full_disk(tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client", reason="the extra metrics is not installed")
    address, log = f"unix:{tmp_path}/fusion.sock", tmp_path / "log"
    with log.open("wb") as stderr:
        command = [*COMMAND, "--listen", address, "--store", str(tmp_path / "s.sqlite"), "--metrics", "127.0.0.1:0"]
        process = subprocess.Popen(command, stderr=stderr)
    try:
        with grpc.insecure_channel(address) as channel, FusionClient(address) as client:
            grpc.channel_ready_future(channel).result(WAIT_S)
            session = client.join("ant", GRID).session_id
            health = watch_health(channel)
            assert next(health) == SERVING
            with limited_files(process, 4096):
                for seq in (1, 2, 3):
                    with pytest.raises(StorageError):
                        list(client.contribute([request(session, make_subset("ant", seq, {0: [seq]}))], 20.0))
                assert next(health) == NOT_SERVING
                assert check_health(channel, "gausslite.v1.FusionService") == NOT_SERVING
                assert check_health(channel, "liveness") == SERVING
                assert metric(log, "store_writable") == 0
            assert next(health) == SERVING
            assert metric(log, "store_writable") == 1
            list(client.contribute([request(session, make_subset("ant", 4, {0: [4]}))], 20.0))
            assert client.status().fused_gaussians == 1
    finally:
        process.terminate()
        process.wait(20)
    lines = log.read_text().splitlines()
    assert len([line for line in lines if "NOT_SERVING" in line and "refused (disk I/O error)" in line]) == 1
    assert len([line for line in lines if "SERVING again" in line]) == 1


def metric(log: Path, name: str) -> float:
    """Return a metric of the server that has written this log."""
    port = re.search(r"metrics.*:(\d+)", log.read_text())
    assert port is not None
    with urllib.request.urlopen(f"http://127.0.0.1:{port[1]}/metrics", timeout=20) as response:
        value = re.search(rf"^gausslite_fusion_{name}(?:{{[^}}]*}})? (\S+)$", response.read().decode(), re.MULTILINE)
    assert value is not None
    return float(value[1])


def test_a_store_at_its_limit_is_not_writable_until_data_is_deleted(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite", max_bytes=1 << 20)
    with fusion_server(store) as t:
        session = t.client.join("ant", GRID).session_id
        health = watch_health(t.channel)
        assert next(health) == SERVING
        with pytest.raises(StorageError):
            t.send(*(request(session, make_subset("ant", seq, {seq: [1] * 1000})) for seq in range(1, 90)))
        assert next(health) == NOT_SERVING
        t.client.leave(session, forget=True)
        assert next(health) == SERVING
    store.close()


def test_a_check_leaves_nothing_in_the_store(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite", max_bytes=1 << 20)
    probe = StorageProbe(store)
    for _ in range(20):
        probe.check()
    assert probe.is_writable
    assert store.agents() == ()
    assert (tmp_path / "store.sqlite").stat().st_size < 1 << 20
    store.close()


class StandingStore(SqliteStore):
    """A store whose disk takes no write until it is `running`."""

    def __init__(self) -> None:
        super().__init__()
        self.running = threading.Event()
        self.running.set()

    def put_all(self, updates: Sequence[EncodedSubset]) -> list[PutOutcome]:
        assert self.running.wait(WAIT_S)
        return super().put_all(updates)

    def save_record(self, agent_id: str, name: str, data: bytes) -> None:
        assert self.running.wait(WAIT_S)
        super().save_record(agent_id, name, data)


@pytest.mark.parametrize("limit", [(traffic, "_LONGEST_WAIT_S"), (server, "_CHECK_LIMIT_S")])
def test_health_follows_the_acknowledgements_and_a_check_that_does_not_end(
    limit: tuple[object, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = StandingStore()
    monkeypatch.setattr(*limit, 0.2)
    if limit[0] is server:
        monkeypatch.setattr(server, "_CHECK_S", 0.0)
    with fusion_server(store) as t:
        session = t.client.join("ant", GRID).session_id
        health = watch_health(t.channel)
        assert next(health) == SERVING
        store.running.clear()
        sender = threading.Thread(target=t.send, args=[request(session, make_subset("ant", 1, {0: [1]}))])
        sender.start()
        try:
            assert next(health) == NOT_SERVING
        finally:
            store.running.set()
        sender.join()
        assert next(health) == SERVING


def test_calls_are_answered_while_a_join_waits_for_the_disk() -> None:
    store = StandingStore()
    with fusion_server(store) as t:
        session = t.client.join("ant", GRID).session_id
        store.running.clear()
        joining = threading.Thread(target=t.client.join, args=["bee", GRID])
        joining.start()
        try:
            # these need the lock that the join holds, and wait for it in threads
            waiting = [t.stub.KeepSession.future(pb.KeepSessionRequest(session_id=name)) for name in (session, "none")]
            assert [check_health(t.channel, "") for _ in range(20)] == [SERVING] * 20
            assert t.servicer.engine.maps.revision() > 0
        finally:
            store.running.set()
        joining.join()
        assert waiting[0].result(WAIT_S).incarnation_id == store.incarnation_id
        assert waiting[1].exception(WAIT_S).code() == grpc.StatusCode.NOT_FOUND


def test_acknowledgements_are_late_after_five_seconds_and_counted_by_their_time() -> None:
    now_s = 0.0
    times = Acknowledgements(lambda: now_s)
    first, second = Future[PutOutcome](), Future[PutOutcome]()
    times.add("ant", first)
    now_s = 4.0
    times.add("bee", second)
    times.check()
    now_s = 5.5
    pytest.raises(UnavailableError, times.check).match("2 messages wait for their acknowledgement, agent 'ant' for 6 s")
    first.set_exception(StorageError("full"))
    times.check()
    second.cancel()
    counts, total_s = times.histogram()
    assert (counts[8], counts[10], sum(counts), total_s) == (1, 1, 2, 7.0)


def test_the_messages_that_one_agent_has_sent_ahead_are_no_illness_of_the_server() -> None:
    now_s = 0.0
    times = Acknowledgements(lambda: now_s)
    ahead = [Future[PutOutcome]() for _ in range(4)]
    for put in ahead:
        times.add("eve", put)
    # alone: each waits longer than the one before, but the agent has an answer every 4 s
    for put in ahead[:3]:
        now_s += 4.0
        times.check()
        put.set_exception(StorageError("full"))
    # beside a robot that is answered at once, a message may wait for its share
    for _ in range(3):
        now_s += 4.0
        put = Future[PutOutcome]()
        times.add("ant", put)
        put.set_exception(StorageError("full"))
        times.check()
    now_s += 4.0
    waits = Future[PutOutcome]()
    times.add("ant", waits)
    # nobody has been answered for more than 5 s
    now_s += 4.0
    with pytest.raises(UnavailableError, match="2 messages wait for their acknowledgement, agent 'eve' for 20 s"):
        times.check()
    # a late answer is no sign of health
    now_s += 4.0
    waits.set_exception(StorageError("full"))
    pytest.raises(UnavailableError, times.check).match("1 messages wait")
