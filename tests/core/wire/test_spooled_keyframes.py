"""Keyframes in the spool: one order with the voxel updates, kept over a restart, sent again if the server lost them."""

from pathlib import Path

from fusion_running import CAMERA, GRID, RunningServer, frame, fusion_server, make_batch
from uplink_running import WAIT_S, uplink

from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import frame_to_message
from gausslite.wire.spool import Purpose, Spool, SpooledKeyframe
from gausslite.wire.update_sender import UplinkSettings


def keyframe(index: int, value: float, size: int = 1000) -> SpooledKeyframe:
    return SpooledKeyframe(index, value, b"", bytes(size))


def encoded(index: int, value: float = 100.0) -> SpooledKeyframe:
    return SpooledKeyframe(index, value, b"", frame_to_message(frame(index, CAMERA)).SerializeToString())


def test_the_highest_value_per_byte_of_updates_and_keyframes_comes_first() -> None:
    spool = Spool(None, "robot", GRID)
    # one Gaussian is 40 bytes on the wire: 10 and 1 updates per byte
    spool.enqueue(make_batch({1: [399], 2: [39]}), Purpose.ROI)
    spool.enqueue_keyframe(keyframe(7, 5000.0))
    spool.enqueue_keyframe(keyframe(8, 100.0))
    spool.enqueue(make_batch({3: [10_000]}), Purpose.HANDOVER)
    cells = {make_batch({cell: [1]}).keys[0]: cell for cell in (1, 2, 3)}
    order: list[str] = []
    while (due := spool.next_round(1, 0.0)) is not None:
        order += [f"keyframe {each.frame_index}" for each in due.keyframes]
        if due.voxels is not None:
            order += [f"voxel {cells[key]}" for key in due.voxels.batch.keys]
            spool.mark_done(due.voxels)
        spool.mark_keyframes_done(due.keyframes)
    spool.close()
    assert order == ["voxel 1", "keyframe 7", "voxel 2", "keyframe 8", "voxel 3"]


def test_a_round_holds_about_max_bytes_of_both() -> None:
    spool = Spool(None, "robot", GRID)
    spool.enqueue(make_batch({cell: [400] for cell in range(1, 6)}), Purpose.ROI)
    for index in range(4):
        spool.enqueue_keyframe(keyframe(index, 1000.0))
    due = spool.next_round(2300, 0.0)
    spool.close()
    assert due is not None
    assert due.voxels is not None
    assert (len(due.voxels.batch), len(due.keyframes)) == (5, 2)


def test_a_replaced_keyframe_is_deleted_and_a_newer_one_of_the_same_frame_stays_pending(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "x.spool", "robot", GRID)
    spool.enqueue_keyframe(keyframe(1, 5.0))
    due = spool.next_round(10_000, 0.0)
    assert due is not None
    spool.enqueue_keyframe(keyframe(1, 6.0, size=10))
    spool.mark_keyframes_done(due.keyframes)
    assert spool.pending_keyframes == 1
    spool.enqueue_keyframe(keyframe(2, 5.0), replaced=1)
    spool.close()
    restarted = Spool(tmp_path / "x.spool", "robot", GRID)
    assert [each.frame_index for each in restarted.keyframes()] == [2]
    assert restarted.keyframe_indices() == (2,)
    restarted.close()


def test_keyframes_reach_the_server_within_the_bandwidth_of_the_updates(fusion: RunningServer) -> None:
    settings = UplinkSettings(kbps=100_000, interval_s=0.0)
    with uplink(fusion.client.address, settings) as link:
        link.enqueue(make_batch({1: [5], 2: [7]}))
        for index in (3, 8):
            link.enqueue_keyframe(encoded(index))
        assert link.drain(WAIT_S)
        counters = link.counters()
        [agent] = fusion.client.status().agents
    assert agent.keyframes == counters.keyframes_sent == 2
    assert counters.keyframes_waiting == 0
    assert counters.keyframe_bytes == sum(len(encoded(index).data) for index in (3, 8))


def test_a_server_that_lost_its_keyframes_gets_them_again_and_one_that_has_them_does_not(tmp_path: Path) -> None:
    path = tmp_path / "x.spool"
    with fusion_server() as fusion, uplink(fusion.client.address, spool=path) as link:
        link.enqueue_keyframe(encoded(3))
        assert link.drain(WAIT_S)
        first = link.counters().keyframe_bytes
    with fusion_server() as fusion:
        for expected_bytes in (first, 0):
            with uplink(fusion.client.address, spool=path) as link:
                link.enqueue(make_batch({1: [expected_bytes + 1]}))
                assert link.drain(WAIT_S)
                assert link.counters().keyframe_bytes == expected_bytes
                assert link.counters().keyframes_waiting == 0
        [agent] = fusion.client.status().agents
    assert agent.keyframes == 1


def test_the_server_keeps_exactly_the_selected_keyframes(fusion: RunningServer, tmp_path: Path) -> None:
    path = tmp_path / "x.spool"
    with uplink(fusion.client.address, spool=path) as link:
        for index, replaced in ((1, None), (2, None), (3, 1)):
            link.enqueue_keyframe(encoded(index), replaced)
            assert link.drain(WAIT_S)
    spool = Spool(path, "robot", GRID)
    with FusionClient(fusion.client.address, token=spool.token) as client:
        assert tuple(client.join("robot", GRID).keyframes) == (2, 3)
    spool.close()
