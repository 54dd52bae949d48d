"""The mapping worker under load: dropped frames, idle training and their reports."""

import itertools
import sqlite3
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from agent_running import SETTINGS, TASK, Agent, Gate, agent, ball_estimator
from fusion_running import CAMERA, GRID, frame, fusion_server
from uplink_running import uplink
from waiting import wait_until

from gausslite.domain.errors import InvalidInputError, UnavailableError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose, Spool
from gausslite.wire.uplink import Uplink
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.settings import LoadSettings
from gausslite_agent.state import Outcome
from gausslite_language.rules import RuleParser


def test_a_full_queue_drops_and_reports_the_oldest_frame() -> None:
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event())
    with agent(lambda _graph: gate, queue_frames=2) as a:
        a.client.assign_task(TASK)
        first = a.worker.submit(frame(0))
        assert gate.reached.wait(20)
        waiting = [a.worker.submit(frame(index)) for index in range(1, 5)]
        gate.opened.set()
        outcomes = [future.result(20).outcome for future in (first, *waiting)]
        notes = a.worker.status().load_notes
    assert outcomes == [Outcome.MAPPED, Outcome.DROPPED, Outcome.DROPPED, Outcome.MAPPED, Outcome.MAPPED]
    assert "queue of 2 frames" in waiting[0].result().reason
    assert "overload: 2 frames were dropped" in notes


def test_a_task_and_a_look_at_the_camera_are_answered_before_the_frames_that_wait() -> None:
    gates = [Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event()) for _ in range(2)]
    tasks = iter(gates)
    with agent(lambda _graph: next(tasks), queue_frames=4) as a:
        a.client.assign_task(TASK)
        reports = [a.worker.submit(frame(index)) for index in range(4)]
        assert gates[0].reached.wait(20)
        task = a.stub.AssignTask.future(pb.AssignTaskRequest(text="Find the chair"))
        wait_until(lambda: len(a.worker._calls) == 1)
        gates[0].opened.set()
        # the second task's frame is blocked: the task was answered after one frame
        assert task.result(20).graph.text == "Find the chair"
        assert gates[1].reached.wait(20)
        assert [report.done() for report in reports] == [True, False, False, False]
        view = a.worker.camera_view()
        gates[1].opened.set()
        assert view.result(20) is not None
        assert [report.result(20).outcome for report in reports] == [Outcome.MAPPED] * 4


def test_a_task_that_waits_when_the_agent_ends_is_refused() -> None:
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event())
    worker = MappingWorker(SETTINGS, GRID, lambda _graph: gate)
    worker.assign(RuleParser().parse(TASK)).result(20)
    worker.submit(frame(0))
    assert gate.reached.wait(20)
    waiting = worker.assign(RuleParser().parse("Find the chair"))
    closing = threading.Thread(target=worker.close)
    closing.start()
    wait_until(lambda: worker._worker._shutdown)
    gate.opened.set()
    closing.join(20)
    with pytest.raises(UnavailableError, match="shutting down"):
        waiting.result(20)


def test_a_cancelled_report_does_not_keep_its_frame_in_the_queue() -> None:
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event())
    worker = MappingWorker(SETTINGS, GRID, lambda _graph: gate, load=LoadSettings(queue_frames=1))
    worker.assign(RuleParser().parse(TASK)).result(20)
    first = worker.submit(frame(0))
    assert gate.reached.wait(20)
    given_up = worker.submit(frame(1))
    given_up.cancel()
    last = worker.submit(frame(2))
    gate.opened.set()
    assert (first.result(20).outcome, given_up.result(20).outcome) == (Outcome.MAPPED, Outcome.DROPPED)
    assert last.result(20).outcome == Outcome.MAPPED
    worker.close()


def test_a_frame_that_waited_gets_less_time() -> None:
    now_us = itertools.count(step=10)
    settings = replace(SETTINGS, rate_hz=5.0)
    worker = MappingWorker(settings, GRID, ball_estimator, clock=lambda: (next(now_us) + stalled_us) / 1e6)
    stalled_us = 0
    worker.assign(RuleParser().parse(TASK)).result(20)
    busy = threading.Event()
    worker.run(lambda _mapper: busy.wait(20))
    waited = [worker.submit(frame(index)) for index in range(3)]
    stalled_us = 1_000_000
    busy.set()
    reports = [each.result(20) for each in waited]
    status = worker.status()
    worker.close()
    assert [each.iterations for each in reports] == [15, 15, 15]
    assert status.under_trained == 0
    assert all(each.age_s >= 1.0 + each.seconds for each in reports)
    assert status.ages_s == tuple(each.age_s for each in reports)


class SlowDisk(Spool):
    """A spool that takes one second per update, on a clock that nothing else advances."""

    now_s = 0.0

    def enqueue(self, batch: VoxelBatch, purpose: Purpose) -> None:
        self.now_s += 1.0
        super().enqueue(batch, purpose)


def test_publishing_is_part_of_a_frames_time() -> None:
    with fusion_server(SqliteStore()) as fusion:
        spool = SlowDisk(None, "robot", GRID)
        uplink = Uplink(FusionClient(fusion.client.address), "robot", spool, GRID)
        worker = MappingWorker(SETTINGS, GRID, ball_estimator, uplink, clock=lambda: spool.now_s)
        worker.assign(RuleParser().parse(TASK)).result(20)
        report = worker.submit(frame(0)).result(20)
        worker.close()
        uplink.close()
    assert (report.outcome, report.seconds, report.age_s) == (Outcome.MAPPED, 1.0, 1.0)


def after_a_frame(worker: MappingWorker) -> Gaussians:
    worker.assign(RuleParser().parse(TASK)).result(20)
    worker.submit(frame(0)).result(20)
    gaussians: Gaussians = worker.run(lambda mapper: mapper.gaussians()).result(20)
    worker.close()
    return gaussians


def test_idle_training_stops_at_its_limit_and_other_work_runs_in_between() -> None:
    left = [after_a_frame(MappingWorker(SETTINGS, GRID, ball_estimator)) for _ in range(2)]
    np.testing.assert_array_equal(left[0].opacities, left[1].opacities)
    worker = MappingWorker(SETTINGS, GRID, ball_estimator, load=LoadSettings(idle_iterations=5))
    worker.assign(RuleParser().parse(TASK)).result(20)
    worker.submit(frame(0)).result(20)
    # each of these waits behind one iteration at most
    trained = [worker.run(lambda mapper: mapper.gaussians()).result(20) for _ in range(9)]
    status = worker.status()
    assert (status.idle_iterations, status.iterations) == (5, 2)
    assert not np.array_equal(left[0].opacities, trained[-1].opacities)
    np.testing.assert_array_equal(trained[-2].opacities, trained[-1].opacities)
    worker.submit(frame(1)).result(20)
    worker.end_idle_training().result(20)
    idle_map = worker.run(lambda mapper: mapper.gaussians()).result(20)
    later_map = worker.run(lambda mapper: mapper.gaussians()).result(20)
    np.testing.assert_array_equal(idle_map.opacities, later_map.opacities)
    assert worker.status().idle_iterations <= 10
    worker.close()


def fail() -> None:
    raise MemoryError("a moment without memory")


def test_a_failed_idle_iteration_is_logged_and_idle_training_continues_after_the_next_frame(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    worker = MappingWorker(SETTINGS, GRID, ball_estimator, load=LoadSettings(idle_iterations=3))
    worker.assign(RuleParser().parse(TASK)).result(20)
    with monkeypatch.context() as broken:
        worker.run(lambda mapper: broken.setattr(mapper, "idle_step", fail)).result(20)
        worker.submit(frame(0)).result(20)
        worker.run(lambda _mapper: None).result(20)
    assert "a moment without memory" in caplog.text
    assert worker.status().idle_iterations == 0
    worker.submit(frame(1)).result(20)
    for _ in range(9):
        worker.run(lambda _mapper: None).result(20)
    assert worker.status().idle_iterations == 3
    worker.close()


def test_without_idle_iterations_nothing_is_trained_between_frames() -> None:
    worker = MappingWorker(SETTINGS, GRID, ball_estimator)
    worker.assign(RuleParser().parse(TASK)).result(20)
    worker.submit(frame(0)).result(20)
    worker.end_idle_training().result(20)
    assert worker.status().idle_iterations == 0
    worker.close()


def test_waiting_frames_are_dropped_at_shutdown() -> None:
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event())
    worker = MappingWorker(SETTINGS, GRID, lambda _graph: gate)
    worker.assign(RuleParser().parse(TASK)).result(20)
    futures = [worker.submit(frame(index)) for index in range(3)]
    assert gate.reached.wait(20)
    threading.Timer(0.05, gate.opened.set).start()
    worker.close()
    assert [future.result(0).outcome for future in futures] == [Outcome.MAPPED, Outcome.DROPPED, Outcome.DROPPED]
    pytest.raises(UnavailableError, worker.run, lambda mapper: mapper.table.count).match("shutting down")


def test_a_frame_larger_than_a_message_is_made_smaller_and_the_stream_continues(robot: Agent) -> None:
    size = (3840, 2880)
    noise = np.random.default_rng(0).integers(0, 255, (*size[::-1], 3), np.uint8)
    images = {"rgb": noise, "depth_m": np.full(size[::-1], 2.0, np.float32), "camera": CAMERA.resized(*size)}
    robot.client.assign_task(TASK)
    outcomes = list(robot.client.ingest([frame(0, CAMERA), replace(frame(1, CAMERA), **images), frame(2, CAMERA)]))
    assert [each.outcome for each in outcomes] == [pb.FRAME_OUTCOME_MAPPED] * 3, [each.reason for each in outcomes]


def test_an_invalid_frame_is_rejected_and_the_stream_continues() -> None:
    opened = threading.Event()
    opened.set()
    fussy = Gate(
        ball_estimator(RuleParser().parse(TASK)), opened, fail_at=1, failure=InvalidInputError("points: too far")
    )
    with agent(lambda _graph: fussy) as a:
        a.client.assign_task(TASK)
        outcomes = list(a.client.ingest([frame(i, CAMERA) for i in range(3)]))
        assert a.client.status().frames_rejected == 1
    mapped, rejected = pb.FRAME_OUTCOME_MAPPED, pb.FRAME_OUTCOME_REJECTED
    assert [each.outcome for each in outcomes] == [mapped, rejected, mapped]
    assert outcomes[1].reason == "points: too far"


def test_after_a_full_spool_all_changes_are_published_again(tmp_path: Path) -> None:
    store, path = SqliteStore(), tmp_path / "robot.spool"
    with fusion_server(store) as fusion, uplink(fusion.client.address, spool=path) as link, agent(uplink=link) as a:
        a.client.assign_task(TASK)
        limit = sqlite3.connect(path)
        limit.execute("CREATE TRIGGER full BEFORE INSERT ON voxel_updates BEGIN SELECT RAISE(ABORT, 'disk full'); END")
        outcomes = list(a.client.ingest([frame(0, CAMERA), frame(1, CAMERA)]))
        assert [each.outcome for each in outcomes] == [pb.FRAME_OUTCOME_MAPPED] * 2
        assert any("disk full" in note for note in a.client.status().notes)
        limit.execute("DROP TRIGGER full")
        limit.close()
        list(a.client.ingest([frame(2, CAMERA)]))
        assert not any("disk full" in note for note in a.client.status().notes)
        assert link.drain(20.0)
        active = a.worker.run(lambda mapper: mapper.gaussians(active_only=True)).result()
    assert int(store.batches()["robot"].counts.sum()) == len(active) > 0


def test_an_error_of_the_callers_frames_is_raised_as_it_is(robot: Agent) -> None:
    def frames() -> Iterator[Frame]:
        yield frame(0)
        raise OSError("the camera was unplugged")

    robot.client.assign_task(TASK)
    with pytest.raises(OSError, match="unplugged"):
        list(robot.client.ingest(frames()))
