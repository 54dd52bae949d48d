"""The uplink with real servers: all updates arrive, in every situation."""

import sqlite3
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fusion_running import GRID, RunningServer, fusion_server, make_batch
from uplink_running import EAGER, WAIT_S, accepted, expected_kappas, scripted, stored_kappas, uplink
from waiting import wait_until

from gausslite.cli.main import main
from gausslite.domain.errors import MismatchError, StorageError
from gausslite.domain.objects import ObjectReport
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.frames import AlignmentState, FrameAlignment
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.wire.spool import Purpose, Spool, SpooledKeyframe
from gausslite.wire.update_sender import UplinkSettings


def test_the_latest_update_of_each_voxel_arrives() -> None:
    store = SqliteStore()
    enqueued = [{1: [5, 6], 2: [7], 3: [1]}, {2: [], 3: [9, 9, 9]}, {4: [2]}]
    with fusion_server(store) as fusion, uplink(fusion.client.address) as link:
        for voxels in enqueued:
            link.enqueue(make_batch(voxels))
        assert link.drain(WAIT_S)
        counters = link.counters()
    assert stored_kappas(store) == expected_kappas(*enqueued)
    assert counters.voxels_sent == 4
    assert counters.voxels_waiting == 0
    assert counters.subsets_rejected == 0
    assert counters.bytes_sent == counters.roi_bytes > 0


def test_the_agent_declares_its_frame(fusion: RunningServer) -> None:
    T_fused_agent = np.eye(4)
    T_fused_agent[:3, 3] = (4.0, -2.0, 0.5)
    options = replace(EAGER, T_fused_agent=T_fused_agent)
    with uplink(fusion.client.address, options) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        [agent] = fusion.client.status().agents
    assert list(agent.alignment.t_fused_agent.row_major) == T_fused_agent.reshape(-1).tolist()


def test_an_unknown_frame_is_in_the_agents_log_in_the_status_and_beside_the_objects(
    fusion: RunningServer, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    options = replace(EAGER, frame="unknown", check_interval_s=0.1)
    with uplink(fusion.client.address, options) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        wait_until(lambda: "uplink: frame unknown: not in the team's map yet; this server compares" in caplog.text)
        assert fusion.client.status().fused_voxels == 0
        assert main(["status", fusion.client.address]) == 0
        assert main(["objects", fusion.client.address]) == 1
    printed = capsys.readouterr().out
    assert "frame unlocalised: frame unknown: not in the team's map yet" in printed
    assert "note: the objects of robot are left out; frame unknown" in printed


def test_an_agent_that_joins_again_with_its_frame_is_used(
    fusion: RunningServer, caplog: pytest.LogCaptureFixture
) -> None:
    for frame in ("unknown", "team"):
        with uplink(fusion.client.address, replace(EAGER, frame=frame)) as link:
            link.enqueue(make_batch({1: [5], 2: [3]}))
            assert link.drain(WAIT_S)
        assert fusion.client.status().fused_voxels == (0 if frame == "unknown" else 2)


def test_a_quarantine_is_in_the_agents_log_and_in_the_status(
    fusion: RunningServer, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = "frame: contradicts ant, bee: 0.61 m and 20 deg would fit better (ant)"
    quarantined = FrameAlignment(0, AlignmentState.QUARANTINED, message=reason, against=("ant", "bee"))
    with uplink(fusion.client.address, replace(EAGER, check_interval_s=0.1)) as link:
        link.enqueue(make_batch({1: [5]}))
        assert link.drain(WAIT_S)
        fusion.servicer.engine.frames.add("robot", quarantined)
        wait_until(lambda: f"uplink: {reason}" in caplog.text)
        assert main(["status", fusion.client.address]) == 0
    assert "frame quarantined: contradicts ant, bee: 0.61 m and 20 deg" in capsys.readouterr().out


def test_handover_is_counted_separately_and_sends_only_changed_voxels() -> None:
    store = SqliteStore()
    with fusion_server(store) as fusion, uplink(fusion.client.address) as link:
        link.enqueue(make_batch({1: [5], 2: [7]}))
        assert link.drain(WAIT_S)
        before = link.counters()
        link.enqueue(make_batch({1: [5], 2: [7], 3: [0, 0]}), Purpose.HANDOVER)
        assert link.drain(WAIT_S)
        after = link.counters()
        [agent] = fusion.client.status().agents
    assert stored_kappas(store).keys() == expected_kappas({1: [5], 2: [7], 3: [0, 0]}).keys()
    assert after.roi_bytes == before.roi_bytes == agent.roi_bytes
    assert after.handover_bytes == agent.handover_bytes > 0
    assert after.voxels_sent == 2


def test_the_spool_survives_a_restart_of_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    nobody = "127.0.0.1:1"
    with uplink(nobody, spool=path) as link:
        link.enqueue(make_batch({1: [5], 2: [7]}))
        assert not link.drain(0.0)
    store = SqliteStore()
    with fusion_server(store) as fusion, uplink(fusion.client.address, spool=path) as link:
        link.enqueue(make_batch({2: [8]}))
        assert link.drain(WAIT_S)
    assert stored_kappas(store) == expected_kappas({1: [5], 2: [8]})


def test_voxels_with_the_highest_kappa_sum_are_sent_first() -> None:
    slow = UplinkSettings(kbps=1.0, interval_s=0.0)
    with scripted(lambda *_: accepted()) as (server, address), uplink(address, slow) as link:
        link.enqueue(make_batch({cell: [cell] * 40 for cell in range(1, 9)}))
        assert server.received.wait(WAIT_S)
        assert not link.drain(0.0)
        first = server.subsets[0]
    assert first.keys.tolist() == [make_batch({8: [1]}).keys[0]]


def test_small_changes_are_sent_only_when_draining() -> None:
    patient = UplinkSettings(interval_s=0.0, resend_threshold=0.5)
    with scripted(lambda *_: accepted()) as (server, address), uplink(address, patient) as link:
        link.enqueue(make_batch({1: [100]}))
        assert link.drain(WAIT_S)
        link.enqueue(make_batch({1: [101]}))
        link.enqueue(make_batch({2: [1]}))
        assert link.drain(WAIT_S)
    kappas = [subset.kappa_sums.tolist() for subset in server.subsets]
    assert kappas[0] == [100]
    assert sorted(total for subset in kappas[1:] for total in subset) == [1, 101]


def _send_due(spool: Spool, kappa: int) -> bool:
    """Enqueue a voxel with this Σkappa; return whether it was due, and mark it as sent then."""
    spool.enqueue(make_batch({1: [kappa]}), Purpose.ROI)
    if (due := spool.next_round(1 << 20, UplinkSettings().resend_threshold)) is None or due.voxels is None:
        return False
    spool.mark_done(due.voxels)
    return True


def test_a_voxel_is_sent_again_after_growing_to_four_times_its_sent_kappa() -> None:
    spool = Spool(None, "robot", GRID)
    sent = [kappa for kappa in range(10, 700) if _send_due(spool, kappa)]
    assert sent == [10, 40, 160, 640]
    spool.close()


def test_a_voxel_that_lost_a_quarter_of_its_kappa_is_sent_at_once() -> None:
    spool = Spool(None, "robot", GRID)
    assert [_send_due(spool, kappa) for kappa in (100, 400, 301, 300)] == [True, True, False, True]
    spool.close()


_NO_CHECKSUMS = "; ".join(f"ALTER TABLE {table} DROP COLUMN checksum" for table in ("voxel_updates", "keyframes"))
_NO_ORDER = f"{_NO_CHECKSUMS}; DROP INDEX voxel_updates_by_value; ALTER TABLE voxel_updates DROP COLUMN place"


@pytest.mark.parametrize("earlier", [_NO_CHECKSUMS, _NO_ORDER])
def test_a_spool_of_the_two_versions_before_goes_on(tmp_path: Path, earlier: str) -> None:
    path, batch = tmp_path / "spool.sqlite", make_batch({1: [5], 2: [6]})
    spool = Spool(path, "robot", GRID)
    spool.enqueue(batch, Purpose.ROI)
    spool.record_acknowledged(batch.keys[:1], 7)
    spool.enqueue_keyframe(SpooledKeyframe(1, 2.0, b"c", b"image"))
    expected, keyframes = spool.acknowledged_digests(), spool.keyframes()
    assert _send_due(spool, 10)
    spool.close()
    with closing(sqlite3.connect(path)) as database:
        database.executescript(earlier)
    for kappa in (39, 40):
        spool = Spool(path, "robot", GRID)
        found = spool.acknowledged_digests()
        assert (found.tiles.tolist(), found.hashes.tolist()) == (expected.tiles.tolist(), expected.hashes.tolist())
        assert spool.keyframes() == keyframes
        assert _send_due(spool, kappa) == (kappa == 40)
        spool.close()
    with closing(sqlite3.connect(path)) as database:
        database.executescript(f"{_NO_ORDER}; ALTER TABLE voxel_updates DROP COLUMN acknowledged_seq")
    pytest.raises(StorageError, Spool, path, "robot", GRID).match("of another release; let that one send it")


def test_limit_drain_ends_a_drain_that_has_begun() -> None:
    with uplink("127.0.0.1:1") as link:
        link.enqueue(make_batch({1: [5]}))
        timer = threading.Timer(0.05, link.limit_drain, [0.0])
        timer.start()
        assert not link.drain(600.0)
        timer.join()


def test_the_spool_of_another_agent_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "spool.sqlite"
    Spool(path, "robot", GRID).close()
    pytest.raises(MismatchError, Spool, path, "other", GRID).match("'other'")
    pytest.raises(MismatchError, Spool, path, "robot", VoxelGrid(0.5)).match(r"0\.5 m")
    (tmp_path / "noise").write_bytes(b"noise" * 1000)
    pytest.raises(StorageError, Spool, tmp_path / "noise", "robot", GRID).match("noise")
    pytest.raises(StorageError, Spool, tmp_path / "nowhere" / "spool", "robot", GRID).match("nowhere")


def test_the_latest_report_of_objects_is_sent_also_without_voxels(fusion: RunningServer) -> None:
    graph = TaskGraph("t", "Find the mug", ("mug",), (), ())
    with uplink(fusion.client.address) as link:
        link.report_objects(ObjectReport(graph))
        assert link.drain(20)
        [agent] = fusion.client.status().agents
        assert list(agent.targets) == ["mug"]
        changed = replace(graph, targets=("cup",))
        link.report_objects(ObjectReport(changed))
        link.report_objects(ObjectReport(graph))
        link.report_objects(ObjectReport(changed))
        assert link.drain(20)
        assert list(fusion.client.status().agents[0].targets) == ["cup"]
