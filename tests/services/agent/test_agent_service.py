"""The agent service in this process: every call, every frame outcome, every status code."""

import asyncio
import gc
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from unittest.mock import patch

import grpc
import numpy as np
import pytest
from agent_running import TASK, Agent, Gate, agent, ball_estimator
from fusion_running import CAMERA, GRID, frame, fusion_server
from uplink_running import uplink
from waiting import wait_until

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import (
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    ModelFileError,
    QuotaError,
    RateLimitError,
    RevisionGoneError,
    TaskError,
)
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.objects import POINTING
from gausslite.domain.pose import Twist
from gausslite.domain.relevance import BallRegion, PointedObject
from gausslite.domain.task import TargetRole, TaskGraph
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import RegionRelevanceEstimator, RelevanceEstimator, TaskRelevanceEstimator
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire import convert, convert_task
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.servicer import MapChangeLog, NewestTask
from gausslite_language.rules import RuleParser
from gausslite_view.decoding import camera_view_from_message


def test_a_task_is_text_or_a_graph(robot: Agent) -> None:
    graph = robot.client.assign_task(TASK)
    assert graph == RuleParser().parse(TASK)
    assert robot.client.assign_task(graph) == graph
    assert convert_task.graph_from_message(robot.client.status().graph) == graph


def test_nouns_that_cannot_be_found_are_in_the_status_notes() -> None:
    mug = RegionDetector({"mug_1": BallRegion((0.0, 0.0, 1.2), 0.2)})
    with agent(lambda graph: TaskRelevanceEstimator(graph, mug)) as a:
        assigned = a.client.assign_task("There is a victim behind me. Pick up the mug on the table")
        searched, unsupported, not_seen, lost = a.client.status().notes
    assert assigned.warnings == (lost, "no region matches 'table'; the regions are mug_1")
    assert lost == "'victim' is not part of the task"
    assert searched == f"'mug' is searched as 'mug_1' (ground truth): not seen so far; if a frame shows it, {POINTING}"
    assert unsupported.startswith("no region matches 'table'")
    assert not_seen.startswith("no class of the detector is a 'table': the height of what an object stands on decides")


def stepped(index: int) -> Frame:
    """A view of a box in front of the wall."""
    plain = frame(index)
    depth_m = plain.depth_m.copy()
    depth_m[8:16, 12:20] = 1.0
    return replace(plain, depth_m=depth_m)


def no_detector(graph: TaskGraph) -> RelevanceEstimator:
    return TaskRelevanceEstimator(graph, RegionDetector({}))


def active_gaussians(a: Agent) -> int:
    return int(a.worker.run(lambda mapper: mapper.gaussians()).result(20).active.sum())


def test_an_object_that_a_person_points_at_is_mapped_from_the_next_frame_on() -> None:
    with agent(no_detector) as a:
        a.client.assign_task("Find the chair")
        for index in range(2):
            a.worker.submit(stepped(index)).result(20)
        assert active_gaussians(a) == 0
        graph = a.client.assign_task(pointed=[PointedObject(points_px=((16.0, 12.0),), noun="mug")])
        assert dict(zip(graph.targets, graph.roles, strict=True)) == {
            "chair": TargetRole.OBJECT,
            "mug": TargetRole.POINTED,
        }
        assert graph.queries == ("chair",)
        a.worker.submit(stepped(2)).result(20)
        assert active_gaussians(a) > 0
        (mug,) = a.worker.status().objects
        assert (mug.noun, mug.confidence) == ("mug", 1.0)
        assert mug.centroid_m == pytest.approx((0.0, 0.0, 1.0), abs=0.1)

        a.client.assign_task(excluded_m=[mug.centroid_m])
        report = a.worker.submit(stepped(3)).result(20)
        assert (report.roi_share, a.worker.status().objects) == (0.0, ())
        a.client.assign_task(pointed=[PointedObject(point_m=(0.0, 0.0, 1.0), noun="mug")])
        assert a.worker.submit(stepped(4)).result(20).roi_share > 0
        a.client.assign_task("Find the table")
        assert a.worker.status().objects == ()


@pytest.mark.parametrize(
    ("pointed", "match"),
    [
        (PointedObject(points_px=((99.0, 0.0),)), "expected a pixel of the image"),
        (PointedObject(points_px=((5.0, 5.0),), frame_index=7), "expected a keyframe that is kept, such as 0; got 7"),
        (PointedObject(point_m=(0.0, 0.0, 3.0)), "expected a point on a surface that a frame shows"),
        (PointedObject(boxes_px=((5.0, 5.0, 9.0, 9.0),), noun="a\nb"), "printable"),
        (PointedObject(points_px=((5.0, 5.0),) * 65), "at most 64 points and boxes"),
        (PointedObject(boxes_px=((5.0, 5.0, 9.0, 9.0),) * 40, points_px=((5.0, 5.0),) * 25), "at most 64 points"),
    ],
)
def test_pointing_at_nothing_is_refused_and_changes_nothing(pointed: PointedObject, match: str) -> None:
    with agent(no_detector) as a:
        a.client.assign_task(TASK)
        a.worker.submit(stepped(0)).result(20)
        pytest.raises(InvalidInputError, a.client.assign_task, pointed=[pointed]).match(match)
        assert convert_task.graph_from_message(a.client.status().graph) == RuleParser().parse(TASK)


def test_a_refused_task_is_not_logged_as_an_error_that_nobody_has_looked_at() -> None:
    unseen: list[object] = []

    def refuse() -> TaskGraph:
        raise InvalidInputError("task: expected another one")

    async def assign() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: unseen.append(context))
        with suppress(InvalidInputError):
            await NewestTask().assign(refuse)
        gc.collect()

    asyncio.run(assign())
    assert unseen == []


def test_an_invalid_task_and_frames_before_a_task_are_refused(robot: Agent) -> None:
    pytest.raises(TaskError, robot.client.assign_task, " ")
    pytest.raises(TaskError, robot.client.assign_task, TaskGraph("", "", (), (), ())).match("targets")
    pytest.raises(MismatchError, lambda: list(robot.client.ingest([frame(0)]))).match("AssignTask")
    with pytest.raises(grpc.RpcError) as caught:
        robot.stub.AssignTask(pb.AssignTaskRequest())
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT  # type: ignore[attr-defined]


def test_assign_task_raises_the_error_of_the_estimator() -> None:
    def broken(_graph: TaskGraph) -> RelevanceEstimator:
        raise ModelFileError("model.onnx: expected a YOLO-seg model, got a text")

    with agent(broken) as a, pytest.raises(ModelFileError, match=r"model\.onnx"):
        a.client.assign_task(TASK)


def test_of_many_tasks_the_newest_is_assigned_and_none_of_them_delays_a_frame() -> None:
    begun, opened = threading.Event(), threading.Event()

    def build(graph: TaskGraph) -> RelevanceEstimator:
        begun.set()
        assert opened.wait(20)
        return ball_estimator(graph)

    def is_refused(call: grpc.Future) -> bool:
        return bool(call.done() and call.code() is grpc.StatusCode.FAILED_PRECONDITION)

    damaged = pb.IngestFramesRequest(frame=convert.frame_to_message(frame(7)))
    damaged.frame.t_world_camera.row_major[0] = float("nan")
    with agent(build) as a:
        first = a.stub.AssignTask.future(pb.AssignTaskRequest(text=TASK))
        assert begun.wait(20)
        storm = [
            a.stub.AssignTask.future(pb.AssignTaskRequest(text=f"Find the chair and the box {number}"))
            for number in range(40)
        ]
        # while the first is still being assigned, all but one are refused, and a frame is decoded
        wait_until(lambda: sum(map(is_refused, storm)) == len(storm) - 1)
        [answer] = a.stub.IngestFrames(iter([damaged]))
        assert answer.outcome == pb.FRAME_OUTCOME_REJECTED
        assert not first.done()
        opened.set()
        assert first.result(20).graph.text == TASK
        [newest] = [call for call in storm if not is_refused(call)]
        assigned = newest.result(20).graph.text
        assert a.client.status().graph.text == assigned
    refused = next(call for call in storm if is_refused(call))
    assert refused.details() == "task: superseded by a newer AssignTask before it was assigned"


def test_the_error_of_a_task_whose_caller_has_gone_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    begun, gone = threading.Event(), threading.Event()

    def refuse() -> TaskGraph:
        begun.set()
        assert gone.wait(20)
        raise MismatchError("late")

    async def call() -> None:
        newest = NewestTask()
        calling = asyncio.create_task(newest.assign(refuse))
        await asyncio.to_thread(begun.wait, 20)
        calling.cancel()
        gone.set()
        await asyncio.wait([calling])
        await newest.assign(lambda: TaskGraph("", "", (), (), ()))
        gc.collect()

    asyncio.run(call())
    assert "never retrieved" not in caplog.text


def test_each_frame_has_its_outcome_in_order(robot: Agent) -> None:
    dark = Frame(1, 1, np.zeros((24, 32, 3), np.uint8), np.zeros((24, 32), np.float32), CAMERA, np.eye(4))
    requests = [
        pb.IngestFramesRequest(frame=convert.frame_to_message(each)) for each in (frame(0), dark, frame(2), frame(3))
    ]
    requests[2].frame.t_world_camera.row_major[0] = float("nan")
    robot.client.assign_task(TASK)
    answers = list(robot.stub.IngestFrames(iter(requests)))
    status = robot.client.status()
    assert [answer.index for answer in answers] == [0, 1, 2, 3]
    assert [answer.outcome for answer in answers] == [
        pb.FRAME_OUTCOME_MAPPED, pb.FRAME_OUTCOME_SKIPPED, pb.FRAME_OUTCOME_REJECTED, pb.FRAME_OUTCOME_MAPPED,
    ]  # fmt: skip
    assert "t_world_camera" in answers[2].reason
    assert "depth" in answers[1].reason
    assert answers[0].iterations == 2
    assert answers[0].roi_share > 0
    assert answers[0].age_seconds >= answers[0].seconds > 0
    assert status.age_p99_seconds >= status.age_p50_seconds > 0
    counts = status.frames_mapped, status.frames_skipped, status.frames_dropped, status.frames_rejected
    assert counts == (2, 1, 0, 1)
    assert status.gaussians == answers[3].gaussians > 0
    assert status.hz > 0


def test_a_frame_that_is_not_later_is_refused_unless_the_clock_has_jumped(robot: Agent) -> None:
    def outcomes(*times_ms: int) -> str:
        frames = (replace(frame(0), capture_time_ns=time_ms * 1_000_000) for time_ms in times_ms)
        answers = list(robot.client.ingest(frames))
        reasons.extend(answer.reason for answer in answers if answer.reason)
        return "".join("m" if answer.outcome == pb.FRAME_OUTCOME_MAPPED else "r" for answer in answers)

    reasons: list[str] = []
    robot.client.assign_task(TASK)
    # also on another stream; equal times are no order either
    assert outcomes(9000, 9000, 8990, 9001) == "mrrm"
    assert outcomes(9001, 9002) == "rm"
    # far back, and several ascending times in a row: a clock that was set
    assert outcomes(7000, 6999, 7001) == "mrm"
    assert outcomes(6980, 6985, 6990, 6991, 6995, 6996) == "rrrrmm"
    robot.client.end_mission()
    robot.client.assign_task("Find the chair")
    assert outcomes(6990) == "m"
    assert reasons[0] == (
        "frame capture_time_ns: expected more than 9000000000, that of the frame before, got 9000000000"
    )


def test_the_status_has_the_odometrys_correction(robot: Agent) -> None:
    robot.client.assign_task(TASK)
    assert not robot.client.status().HasField("map_to_odom")
    list(robot.client.ingest(frame(index) for index in range(2)))
    correction = robot.client.status().map_to_odom
    # poses are exact by default
    np.testing.assert_allclose(convert.transform_from_message("t", correction.t_map_odometry), np.eye(4), atol=1e-12)
    assert correction.capture_time_ns == frame(1).capture_time_ns
    assert correction.age_seconds >= 0
    assert correction.translation_std_m == 0


def test_frames_of_a_distorted_moving_camera_are_corrected_and_mapped() -> None:
    motion = CameraMotion(Twist(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.5, 0.0])), readout_s=0.03, exposure_s=0.01)
    frames = [replace(frame(index), motion=motion) for index in range(2)]
    with agent() as a:
        a.client.assign_task(TASK)
        answers = list(a.client.ingest(frames, lens=Lens(LensModel.RADTAN, (-0.2, 0.0, 0.0, 0.0))))
        keyframe = a.worker.run(lambda mapper: mapper.render(CAMERA, np.eye(4)).depth_m).result(20)
    assert [answer.outcome for answer in answers] == [pb.FRAME_OUTCOME_MAPPED] * 2, [a.reason for a in answers]
    assert (keyframe > 0).any()


def test_another_task_switches_the_region_and_an_equivalent_task_changes_nothing() -> None:
    built: list[str] = []

    def build_estimator(graph: TaskGraph) -> RelevanceEstimator:
        built.append(graph.text)
        x_m = 0.0 if "mug" in graph.targets else 0.3
        return RegionRelevanceEstimator([BallRegion((x_m, 0.0, 1.2), 0.2)])

    with agent(build_estimator) as a:
        a.client.assign_task(TASK)
        for index in range(3):
            a.worker.submit(frame(index)).result(20)
        first = a.worker.run(lambda mapper: mapper.gaussians()).result(20)
        a.client.assign_task("Take the mug on the table")
        same = a.worker.run(lambda mapper: mapper.gaussians()).result(20)
        np.testing.assert_array_equal(same.active, first.active)
        assert built == [TASK]
        a.client.assign_task("Find the chair")
        a.worker.submit(frame(3)).result(20)
        turned = a.worker.run(lambda mapper: mapper.gaussians()).result(20)
        # all three showed the first region, and views of the region are remembered
        assert a.worker.status().keyframes_reevaluated == 3
    assert built == [TASK, "Find the chair"]
    assert turned.means_m[turned.active][:, 0].mean() > first.means_m[first.active][:, 0].mean() + 0.1


def test_an_unexpected_error_ends_its_stream_and_not_the_agent() -> None:
    opened = threading.Event()
    opened.set()
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), opened, fail_at=1)
    with agent(lambda _graph: gate) as a:
        a.client.assign_task(TASK)
        with pytest.raises(GaussLiteError, match="unexpected error"):
            list(a.client.ingest([frame(0), frame(1)]))
        [answer] = a.client.ingest([frame(2)])
        assert answer.outcome == pb.FRAME_OUTCOME_MAPPED


def test_render_view_shows_the_map(robot: Agent) -> None:
    rgb, depth_m = robot.client.render(CAMERA, np.eye(4))
    assert not rgb.any()
    assert not depth_m.any()
    robot.client.assign_task(TASK)
    list(robot.client.ingest([frame(index) for index in range(3)]))
    rgb, depth_m = robot.client.render(CAMERA, np.eye(4))
    assert rgb.shape == (24, 32, 3)
    assert np.median(depth_m[depth_m > 0]) == pytest.approx(1.2, abs=0.1)


def test_views_wait_for_frames_and_are_refused_by_name_without_time_for_them() -> None:
    gate = Gate(ball_estimator(RuleParser().parse(TASK)), threading.Event())
    with ThreadPoolExecutor() as viewer, agent(lambda _graph: gate) as a:
        a.client.assign_task(TASK)
        a.worker.submit(frame(0))
        assert gate.reached.wait(20)
        viewed = viewer.submit(a.worker.run_when_idle, lambda _mapper: a.worker.status().mapped)
        wait_until(lambda: a.worker._worker._work_queue.qsize() > 0)
        for index in (1, 2):
            a.worker.submit(frame(index))
        gate.opened.set()
        assert viewed.result(20) == 3
        with (
            patch("gausslite_agent.mapping_worker._IDLE_WAIT_S", 0.0),
            pytest.raises(RateLimitError, match="views: expected time left after mapping, got none within 0 s"),
        ):
            a.client.render(CAMERA, np.eye(4))
        with pytest.raises(QuotaError, match="at most 2073600 pixels, got 6000000"):
            a.client.render(replace(CAMERA, width_px=3000, height_px=2000), np.eye(4))


def test_the_camera_view_shows_the_newest_keyframe_and_the_path(robot: Agent) -> None:
    assert camera_view_from_message(robot.client.camera_view()) is None
    robot.client.assign_task(TASK)
    list(robot.client.ingest([frame(index) for index in range(3)]))
    view = camera_view_from_message(robot.client.camera_view())
    assert view is not None
    assert view.camera == CAMERA
    assert np.abs(view.rgb.astype(int) - frame(view.frame_index).rgb).mean() < 5
    assert 0 < np.count_nonzero(view.roi) < view.roi.size
    assert view.times_ns.tolist() == [frame(index).capture_time_ns for index in range(3)]
    np.testing.assert_allclose(view.path[2], frame(2).T_world_camera, atol=0.05)
    assert len(view.keyframes) >= 1


@pytest.mark.parametrize(
    ("camera", "T_world_camera"),
    [(Camera(1e4, 1e4, 1.0, 1.0, 16384, 16384), np.eye(4)), (CAMERA, np.full((4, 4), np.nan)), (CAMERA, np.eye(3))],
)
def test_an_invalid_camera_or_pose_is_refused(robot: Agent, camera: Camera, T_world_camera: np.ndarray) -> None:
    request = pb.RenderViewRequest(
        camera=convert.camera_to_message(camera), t_world_camera={"row_major": T_world_camera.reshape(-1).tolist()}
    )
    with pytest.raises(grpc.RpcError) as caught:
        robot.stub.RenderView(request)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT  # type: ignore[attr-defined]
    assert robot.client.status().agent_id == "robot"


def follow(updates: Iterator[convert.MapUpdate], table: dict[int, int]) -> int:
    """Apply updates up to the next complete revision; `table` holds the Gaussians per voxel."""
    for update in updates:
        if update.snapshot:
            table.clear()
        if update.batch is not None:
            for key, count in zip(update.batch.keys.tolist(), update.batch.counts.tolist(), strict=True):
                table[key] = count
                if count == 0:
                    del table[key]
        if update.last:
            return update.revision
    raise AssertionError("the stream ended")


def counts_now(worker: MappingWorker) -> dict[int, int]:
    keys = GRID.keys(worker.run(lambda mapper: mapper.gaussians()).result(20).means_m)
    return dict(zip(*(part.tolist() for part in np.unique(keys, return_counts=True)), strict=True))


def test_a_watcher_follows_the_map(robot: Agent) -> None:
    robot.client.assign_task(TASK)
    updates = robot.client.watch_map()
    seen: dict[int, int] = {}
    revision = follow(updates, seen)
    assert seen == {}
    for index in range(3):
        list(robot.client.ingest([frame(index)]))
        before, revision = revision, follow(updates, seen)
        assert revision > before
        assert seen == counts_now(robot.worker)
    updates.close()
    list(robot.client.ingest([frame(3)]))
    resumed = robot.client.watch_map(since_revision=revision)
    follow(resumed, seen)
    resumed.close()
    assert seen == counts_now(robot.worker)


def test_frames_are_mapped_while_the_map_is_compared_for_a_watcher(
    robot: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    update, begun, continued = MapChangeLog.update, threading.Event(), threading.Event()

    def slow_update(*arguments: object) -> None:
        begun.set()
        assert continued.wait(60)
        update(*arguments)

    monkeypatch.setattr(MapChangeLog, "update", slow_update)
    robot.client.assign_task(TASK)
    list(robot.client.ingest([frame(0)]))
    watching = robot.stub.WatchMap(pb.WatchMapRequest())
    try:
        assert begun.wait(20)
        request = pb.IngestFramesRequest(frame=convert.frame_to_message(frame(1)))
        [answer] = robot.stub.IngestFrames(iter([request]), timeout=20)
        assert answer.outcome == pb.FRAME_OUTCOME_MAPPED
    finally:
        continued.set()
    assert len(next(watching).block.subset) > 0
    watching.cancel()


def test_a_watcher_may_select_a_box_or_the_tasks_region(robot: Agent) -> None:
    robot.client.assign_task(TASK)
    list(robot.client.ingest([frame(0)]))
    shown: list[dict[int, int]] = []
    box = AxisAlignedBox((-0.1, -0.1, 0.0), (0.1, 0.1, 5.0))
    for region, roi_only in ((None, False), (box, False), (None, True)):
        updates = robot.client.watch_map(region=region, roi_only=roi_only)
        shown.append({})
        follow(updates, shown[-1])
        updates.close()
    gaussians = robot.worker.run(lambda mapper: mapper.gaussians()).result(20)
    everything, in_box, of_task = shown
    assert 0 < len(in_box) < len(everything)
    assert in_box.items() <= everything.items()
    assert sum(of_task.values()) == gaussians.active.sum()


@pytest.mark.parametrize("since", [1, 2**62])
def test_a_revision_that_is_not_kept_is_out_of_range(robot: Agent, since: int) -> None:
    with pytest.raises(RevisionGoneError, match="since_revision"):
        next(iter(robot.client.watch_map(since_revision=since)))


def test_an_upside_down_region_is_refused(robot: Agent) -> None:
    request = pb.WatchMapRequest(region={"min_m": {"x": 1.0}, "max_m": {"x": -1.0}})
    with pytest.raises(grpc.RpcError) as caught:
        next(robot.stub.WatchMap(request))
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT  # type: ignore[attr-defined]
    pytest.raises(InvalidInputError, AxisAlignedBox, (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)).match("box")


def test_only_the_tasks_region_leaves_the_robot() -> None:
    store = SqliteStore()
    with fusion_server(store) as fusion, uplink(fusion.client.address) as link, agent(uplink=link) as a:
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(index) for index in range(3)]))
        assert link.drain(20.0)
        status = a.client.status()
        gaussians = a.worker.run(lambda mapper: mapper.gaussians()).result(20)
    stored = store.batch("robot")
    assert stored.gaussians.active.all()
    assert len(stored.gaussians) == gaussians.active.sum() < len(gaussians)
    assert status.uplink.connected
    assert status.uplink.bytes_sent > 0
    assert status.uplink.voxels_waiting == 0
