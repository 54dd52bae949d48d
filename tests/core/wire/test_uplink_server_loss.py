"""An idle uplink notices that the server has lost updates, and sends them again."""

import shutil
import sqlite3
from pathlib import Path

import pytest
from fusion_running import GRID, fusion_server, make_batch
from waiting import wait_until

from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose, Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink
from gausslite_operations.store_maintenance import back_up, restore

QUICK = UplinkSettings(interval_s=0.02, first_backoff_s=0.05, check_interval_s=0.1)


def send_then_replace(first: FusionStore, second: FusionStore, tmp_path: Path) -> None:
    """Send everything to a server on the first store, then serve the second one at the same address."""
    address = f"unix:{tmp_path}/fusion.sock"
    spool = Spool(tmp_path / "spool.sqlite", "ant", GRID)
    with fusion_server(first, address=address):
        uplink = Uplink(FusionClient(address, deadline_s=5.0), "ant", spool, GRID, QUICK)
        uplink.enqueue(make_batch({0: [5], 1: [1, 2]}), Purpose.ROI)
        assert uplink.drain(20.0)
        assert uplink.counters().voxels_waiting == 0
    with fusion_server(second, address=address):
        wait_until(lambda: second.totals("ant").voxels == 2)
        assert uplink.drain(20.0)
        uplink.close()
    assert second.totals("ant").gaussians == 3


def test_after_a_restart_with_an_empty_store(tmp_path: Path) -> None:
    send_then_replace(SqliteStore(), SqliteStore(), tmp_path)


def test_after_a_restart_with_a_store_that_has_lost_its_newest_updates(tmp_path: Path) -> None:
    first, path = SqliteStore(tmp_path / "first.sqlite"), tmp_path / "second.sqlite"
    with sqlite3.connect(tmp_path / "first.sqlite") as source, sqlite3.connect(path) as copy:
        source.backup(copy)
    shutil.copy(tmp_path / "first.sqlite-head", tmp_path / "second.sqlite-head")
    # the same incarnation, as after the loss of the log
    second = SqliteStore(path)
    assert second.incarnation_id == first.incarnation_id
    send_then_replace(first, second, tmp_path)
    first.close()
    second.close()


def send_a_map(uplink: Uplink, cells: range) -> int:
    """Send a voxel in each cell; returns the bytes."""
    before = uplink.counters().bytes_sent
    uplink.enqueue(make_batch({cell: [5] * 20 for cell in cells}), Purpose.ROI)
    assert uplink.drain(20.0)
    return uplink.counters().bytes_sent - before


def test_after_a_restore_only_the_tiles_that_differ_are_sent_again(tmp_path: Path) -> None:
    address, store, backup = f"unix:{tmp_path}/fusion.sock", tmp_path / "store.sqlite", tmp_path / "backup.sqlite"
    spool = Spool(tmp_path / "spool.sqlite", "ant", GRID)
    first = SqliteStore(store)
    with fusion_server(first, address=address):
        uplink = Uplink(FusionClient(address, deadline_s=5.0), "ant", spool, GRID, QUICK)
        # 20 tiles along x
        all_bytes = send_a_map(uplink, range(320))
        back_up(store, backup)
        # in tile 3
        uplink.enqueue(make_batch({50: [9] * 20, 51: []}), Purpose.ROI)
        assert uplink.drain(20.0)
        expected = voxels_of(first)
    first.close()
    restore(backup, store)
    sent_before = uplink.counters().bytes_sent
    second = SqliteStore(store)
    with fusion_server(second, address=address):
        wait_until(lambda: voxels_of(second) == expected)
        assert uplink.drain(20.0)
        resent_bytes = uplink.counters().bytes_sent - sent_before
        uplink.close()
    assert 0 < resent_bytes < all_bytes / 8
    second.close()


@pytest.mark.slow
def test_after_a_restore_of_an_equal_store_nothing_is_sent_again(tmp_path: Path) -> None:
    address, store, backup = f"unix:{tmp_path}/fusion.sock", tmp_path / "store.sqlite", tmp_path / "backup.sqlite"
    spool = Spool(tmp_path / "spool.sqlite", "ant", GRID)
    first = SqliteStore(store)
    with fusion_server(first, address=address):
        uplink = Uplink(FusionClient(address, deadline_s=5.0), "ant", spool, GRID, QUICK)
        sent = send_a_map(uplink, range(40))
    first.close()
    back_up(store, backup)
    restore(backup, store)
    second = SqliteStore(store)
    with fusion_server(second, address=address):
        wait_until(lambda: uplink.counters().joins == 2)
        assert uplink.drain(20.0)
        assert uplink.counters().bytes_sent == sent
        # the spool trusts the restored store from now on
        assert spool.is_stored_by(second.incarnation_id, second.totals("ant").highest_update_seq)
        uplink.close()
    second.close()


def test_an_evicted_agent_sends_everything_again(tmp_path: Path) -> None:
    store, address = SqliteStore(), f"unix:{tmp_path}/fusion.sock"
    with fusion_server(store, address=address) as t:
        uplink = Uplink(FusionClient(address, deadline_s=5.0), "ant", Spool(None, "ant", GRID), GRID, QUICK)
        send_a_map(uplink, range(40))
        t.client.evict("ant")
        wait_until(lambda: store.totals("ant").voxels == 40)
        uplink.close()


def voxels_of(store: FusionStore) -> dict[int, tuple[int, int]]:
    """Return Σkappa and count of ant's updates by voxel."""
    batch = store.batch("ant")
    totals = zip(batch.kappa_sums.tolist(), batch.counts.tolist(), strict=True)
    return dict(zip(batch.keys.tolist(), totals, strict=True))


def test_a_robot_that_reboots_without_its_spool_keeps_its_map(tmp_path: Path) -> None:
    store, address = SqliteStore(), f"unix:{tmp_path}/fusion.sock"
    with fusion_server(store, address=address) as t:
        for cells, gaussians in ((range(40), 80), (range(3, 6), 80)):
            spool = Spool(None, "ant", GRID)
            uplink = Uplink(FusionClient(address, deadline_s=5.0), "ant", spool, GRID, QUICK)
            uplink.enqueue(make_batch({cell: [5, 6] for cell in cells}), Purpose.ROI)
            assert uplink.drain(20.0)
            uplink.close()
            status = t.client.status()
            assert (status.fused_gaussians, status.fused_voxels) == (gaussians, 40)
