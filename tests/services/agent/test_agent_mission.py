"""A whole mission: a replayed sequence gives a map, a report and its region on the server."""

import asyncio
import json
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import grpc
import numpy as np
import pytest
from agent_running import agent_process, cup_options, end
from fusion_running import CAMERA, GRID, RunningServer, frame, fusion_server
from plugin_entries import register
from signals import hangup
from uplink_running import uplink

from gausslite.codec.ply import read_ply
from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError, StorageError, TaskError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Trajectory
from gausslite.domain.relevance import BallRegion, Region
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.mission.results import locked_folder
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import SourceSettings
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.plugins import Group
from gausslite.v1.agent_service_pb2 import FRAME_OUTCOME_MAPPED, AssignTaskRequest
from gausslite.v1.agent_service_pb2_grpc import AgentServiceStub
from gausslite.wire.run_service import run_service
from gausslite.wire.server import serve_until_stopped
from gausslite_agent.keyframe_upload import open_upload
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission import AgentMission
from gausslite_agent.settings import AgentSettings, parse_arguments
from gausslite_agent.state import EndRequest, MissionState
from gausslite_language.rules import RuleParser
from gausslite_view.decoding import stored_keyframe_from_message
from gausslite_view.map_history import read_map_history
from gausslite_view.timeline import read_timeline

MUG = BallRegion((0.0, 0.0, 1.2), 0.2)


@dataclass
class Wall(Source):
    """A sequence of frames of one wall."""

    count: int = 8
    name: str = "wall"
    up_axis: tuple[float, float, float] = (0.0, -1.0, 0.0)
    depth_registered: bool = True
    camera_ideal: bool = True
    poses_exact: bool = True
    camera: Camera = CAMERA
    broken_at: int | None = None
    is_blind: bool = False
    read: list[int] = field(default_factory=list)
    reached: threading.Event = field(default_factory=threading.Event)

    def __len__(self) -> int:
        return self.count

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        if i == self.broken_at:
            raise DatasetError(f"wall/frame-{i}.png: expected an image, got noise")
        self.read.append(i)
        if len(self.read) == 2:
            self.reached.set()
        seen = frame(i, CAMERA)
        return replace(seen, depth_m=np.zeros_like(seen.depth_m)) if self.is_blind else seen

    def indices(self) -> Sequence[int]:
        return range(self.count)

    def trajectory(self) -> Trajectory:
        raise DatasetError("wall: expected no trajectory to be read")

    def regions(self) -> Mapping[str, Region]:
        return {"mug": MUG}


def settings(out: Path | None, *more: str) -> AgentSettings:
    options = ["--agent-id", "robot", "--task", "Pick up the mug", "--max-gaussians", "2000", "--iterations", "2"]
    options += ["--source", "wall", "--set", "threads=1", *more]
    return parse_arguments([*options, "--out", str(out)] if out is not None else options)


@contextmanager
def agent_mission(options: AgentSettings, address: str | None = None) -> Iterator[tuple[AgentMission, MappingWorker]]:
    with nullcontext() if address is None else uplink(address) as link:
        limits = options.link.keyframes, options.link.keyframes_during_mission
        keyframes = None if link is None else open_upload(link, GRID, *limits)
        worker = MappingWorker(
            options.mission, GRID, lambda _graph: RegionRelevanceEstimator([MUG]), link, keyframe_upload=keyframes
        )
        try:
            yield AgentMission(options, worker, RuleParser()), worker
        finally:
            worker.close()


def stream_of(wall: Wall, options: AgentSettings) -> FrameStream:
    assert options.source is not None
    return FrameStream.select(wall, options.source)


def test_a_mission_leaves_a_map_a_report_and_its_region_on_the_server(tmp_path: Path) -> None:
    store, options = SqliteStore(), settings(tmp_path)
    with fusion_server(store) as fusion, agent_mission(options, fusion.client.address) as (mission, worker):
        mission.run(stream_of(Wall(), options))
        assert mission.state == MissionState.ENDED
        count = worker.status().gaussians
        [agent] = fusion.client.status().agents
    written, report = read_ply(tmp_path / "map.ply"), json.loads((tmp_path / "report.json").read_text())
    assert len(written) == count == report["gaussians"]
    assert report["frames"] == 8
    assert report["hz"] > 0
    assert report["frame_age_p99_s"] >= report["frame_age_p50_s"] > 0
    assert 0 < report["roi_share"] < 1
    assert report["bytes_sent"] == agent.roi_bytes > 0
    assert report["handover_bytes"] == agent.handover_bytes == agent.keyframes == 0
    timeline = read_timeline(tmp_path)
    assert len(timeline["frame"]) == report["frames"]
    assert 0 < read_map_history(tmp_path)[0].total <= count
    assert timeline["roi_share"].mean() == pytest.approx(report["roi_share"], rel=1e-4)
    assert report["map_shared_percent"] == pytest.approx(100 * written.active.mean())
    assert agent.gaussians == written.active.sum()


def test_handover_brings_the_whole_map_and_the_keyframes(fusion: RunningServer, tmp_path: Path) -> None:
    options = settings(tmp_path, "--set", "handover=true", "--fusion", "localhost:1")
    with agent_mission(options, fusion.client.address) as (mission, worker):
        mission.run(stream_of(Wall(), options))
        [agent] = fusion.client.status().agents
        keyframes = worker.run(lambda mapper: mapper.store.kept).result(20)
        stored = stored_keyframe_from_message(fusion.client.keyframe(agent.agent_id))
    assert stored is not None
    assert stored.roi is not None
    np.testing.assert_array_equal(stored.roi, keyframes[-1].relevance.roi)
    report = json.loads((tmp_path / "report.json").read_text())
    assert agent.gaussians == report["gaussians"]
    assert agent.handover_bytes == report["handover_bytes"] > 0
    assert agent.roi_bytes == report["bytes_sent"] > 0
    assert agent.keyframes == len(keyframes) > 0


def test_without_a_fusion_server_nothing_is_sent(tmp_path: Path) -> None:
    options = settings(tmp_path, "--set", "test-every=4", "--frames", "0:6")
    wall = Wall()
    with agent_mission(options) as (mission, _):
        mission.run(stream_of(wall, options))
    report = json.loads((tmp_path / "report.json").read_text())
    assert wall.read == [0, 1, 2, 4, 5]
    assert (report["frames"], report["bytes_sent"], report["map_shared_percent"]) == (5, 0, 0)


def test_a_stopped_mission_writes_its_current_map(tmp_path: Path) -> None:
    options, wall = settings(tmp_path), Wall(10_000)
    with agent_mission(options) as (mission, _):
        thread = threading.Thread(target=mission.run, args=(stream_of(wall, options),))
        thread.start()
        assert wall.reached.wait(20)
        mission.stop()
        thread.join(20)
        assert not thread.is_alive()
        assert mission.state == MissionState.ENDED
    assert json.loads((tmp_path / "report.json").read_text())["frames"] < 10_000
    assert len(read_ply(tmp_path / "map.ply")) > 0


def test_without_a_plug_in_that_selects_keyframes_none_are_sent(
    fusion: RunningServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(monkeypatch, Group.KEYFRAME_UPLOADS)
    options = settings(tmp_path, "--set", "handover=true", "--fusion", "localhost:1")
    with agent_mission(options, fusion.client.address) as (mission, _):
        mission.run(stream_of(Wall(), options))
        [agent] = fusion.client.status().agents
    assert agent.handover_bytes > 0
    assert agent.keyframes == 0


def test_a_request_ends_a_replay_with_its_handover(fusion: RunningServer, tmp_path: Path) -> None:
    options, wall = settings(tmp_path), Wall(10_000)
    with agent_mission(options, fusion.client.address) as (mission, _):
        thread = threading.Thread(target=mission.run, args=(stream_of(wall, options),))
        thread.start()
        assert wall.reached.wait(20)
        summary = mission.end(EndRequest(handover=True, drain_s=20.0))
        thread.join(20)
        [stored] = fusion.client.status().agents
    assert stored.handover_bytes > 0
    assert stored.gaussians == summary.gaussians


def test_errors_of_task_source_and_disk_are_raised(tmp_path: Path) -> None:
    options = settings(tmp_path)
    with agent_mission(replace(options, task="!")) as (mission, _), pytest.raises(TaskError):
        mission.run(stream_of(Wall(), options))
    pytest.raises(InvalidInputError, FrameStream.select, Wall(), SourceSettings("wall", size="big")).match("size")
    with agent_mission(replace(options, out=tmp_path / "gone")) as (mission, _):
        pytest.raises(StorageError, mission.run, stream_of(Wall(), options)).match("gone")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--source", "/nowhere"], "--task"),
        (["--source", "/nowhere", "--task", "Pick up the mug"], "/nowhere"),
        (["--source", "sim:attic", "--task", "Pick up the mug"], "sim:attic"),
        (["--source", "sim:home?trajectory=9", "--task", "Pick up the mug"], "trajectory"),
        (["--source", "sim:home", "--task", "Pick up the mug", "--frames", "500:"], "500:"),
        (["--source", "sim:home", "--task", "Pick up the mug", "--size", "big"], "size"),
        (
            ["--source", "sim:home", "--task", "Pick up the mug", "--set", "test-every=1"],
            "test-every: expected at least 2",
        ),
        (["--set", "threads=0"], "threads"),
        (["--task", "Pick up the mug"], "expected --detector FILE.onnx"),
        (["--max-gaussians", "0"], "--max-gaussians: expected at least 1"),
        (["--agent-id", ""], "--agent-id"),
        (["--agent-id", "husky-\udcff"], "--agent-id: expected 1 to 64 letters, digits"),
        (["--set", f"mission={'x' * 256}"], "mission: expected 1 to 64 letters, digits"),
        (["--set", "world-frame=\udcff"], "world-frame: expected UTF-8 text"),
        (["--set", "voxel-size=nan"], "voxel"),
        (["--rate", "-1"], "rate"),
        (["--listen", "nowhere"], "HOST:PORT"),
        (["--out", "/dev/null/x"], "/dev/null/x"),
        (["--set", "uplink-kbps=0"], "kbps"),
        (["--set", "drain-timeout=nan"], "drain-timeout"),
        (["--fusion", ""], "--fusion: expected HOST:PORT or unix:PATH"),
        (["--fusion", "10.0.0.7"], "--fusion: expected HOST:PORT or unix:PATH"),
        (["--parser", "localhost:http"], "--parser: expected HOST:PORT or unix:PATH"),
        (["--parser", "localhost:0"], "--parser: expected the port that the service listens on"),
        (["--set", "up=0,0,0"], "up axis"),
        (["--task", "!"], "task text"),
        (["--set", "seed=-1"], "seed"),
        (["--max-gaussians", "3000000000000"], "max_gaussians"),
        (["--detector", __file__], "expected a readable ONNX model"),
        (["--detector", "/nowhere.onnx"], "/nowhere.onnx"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_code_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from gausslite_agent.program import run

    assert run(["--listen", "127.0.0.1:0", *arguments]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line


def test_two_agents_cannot_write_into_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from gausslite_agent.program import run

    with locked_folder(tmp_path / "out"):
        # the missing detector ends an agent that does not look whether the folder is in use
        arguments = ["--listen", "127.0.0.1:0", "--out", str(tmp_path / "out"), "--detector", "/nowhere.onnx"]
        assert run(arguments) == 2
    assert "another run writes its results there; choose another --out" in capsys.readouterr().err


def test_assign_task_names_the_parser_that_does_not_answer(tmp_path: Path) -> None:
    with agent_process(tmp_path, "--parser", "127.0.0.1:1") as (process, client):
        # a plain stub, since the client would try again
        with (
            grpc.insecure_channel(client.address) as channel,
            pytest.raises(grpc.RpcError, match=r"parser 127\.0\.0\.1:1: "),
        ):
            AgentServiceStub(channel).AssignTask(AssignTaskRequest(text="Pick up the cup"), timeout=20.0)
        end(process)


@pytest.mark.parametrize(
    "numbers",
    [
        (signal.SIGTERM,),
        pytest.param((signal.SIGHUP,), marks=[hangup, pytest.mark.slow]),
        pytest.param((signal.SIGINT, signal.SIGINT, signal.SIGTERM), id="a launcher", marks=pytest.mark.slow),
    ],
)
def test_received_frames_give_a_map_and_a_report_on_signals(tmp_path: Path, numbers: tuple[signal.Signals]) -> None:
    out, options = tmp_path / "out", cup_options(tmp_path)
    with agent_process(tmp_path, *options, "--out", str(out), "--task", "Pick up the cup") as (process, client):
        client.assign_task("Pick up the cup")
        outcomes = list(client.ingest([frame(i, CAMERA) for i in range(2)]))
        for number in numbers[:-1]:
            process.send_signal(number)
        log = end(process, number=numbers[-1])
    report = json.loads((out / "report.json").read_text())
    assert [outcome.outcome for outcome in outcomes] == [FRAME_OUTCOME_MAPPED] * 2
    assert report["frames"] == 2
    assert len(read_ply(out / "map.ply")) == report["gaussians"] > 0
    assert "ended" in log


def test_without_a_mapped_frame_nothing_is_overwritten(tmp_path: Path) -> None:
    options = replace(settings(tmp_path), source=None)
    (tmp_path / "map.ply").write_text("of an earlier mission")
    with agent_mission(options) as (mission, _):
        mission.assign_task()
        mission.stop()
        mission.finish()
    assert (tmp_path / "map.ply").read_text() == "of an earlier mission"


def test_a_corrupt_frame_is_skipped_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    options = settings(tmp_path)
    with agent_mission(options) as (mission, _):
        mission.run(stream_of(Wall(broken_at=3), options))
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["frames"], report["frames_corrupt"], report["stopped_by"]) == (7, 1, None)
    assert "frame 3 skipped: wall/frame-3.png" in caplog.text


def test_a_reason_that_repeats_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    options = settings(tmp_path)
    with agent_mission(options) as (mission, worker):
        mission.run(stream_of(Wall(is_blind=True), options))
        assert worker.status().skipped == 8
    assert caplog.text.count("skipped: no pixel has a depth") == 1


def test_with_strict_a_corrupt_frame_ends_the_mission_after_its_map_is_sent_and_written(
    fusion: RunningServer, tmp_path: Path
) -> None:
    options = settings(tmp_path, "--set", "strict=true")
    with agent_mission(options, fusion.client.address) as (mission, _):
        pytest.raises(DatasetError, mission.run, stream_of(Wall(broken_at=3), options)).match("frame-3")
        [agent] = fusion.client.status().agents
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["frames"] == 3
    assert "frame-3.png" in report["stopped_by"]
    assert agent.gaussians == read_ply(tmp_path / "map.ply").active.sum() > 0


def test_a_corrupt_first_frame_overwrites_nothing_with_strict(tmp_path: Path) -> None:
    options = settings(tmp_path, "--set", "strict=true")
    (tmp_path / "map.ply").write_text("of an earlier mission")
    with agent_mission(options) as (mission, _), pytest.raises(DatasetError, match="frame-0"):
        mission.run(stream_of(Wall(broken_at=0), options))
    assert (tmp_path / "map.ply").read_text() == "of an earlier mission"


def test_an_error_during_shutdown_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def serve() -> None:
        async def until() -> None:
            try:
                signal.raise_signal(signal.SIGTERM)
                await asyncio.Event().wait()
            finally:
                raise StorageError("map.ply: the disk is full")

        await serve_until_stopped(f"unix:{tmp_path}/x.sock", [], until)

    assert run_service("program", serve) == 2
    assert "program: map.ply: the disk is full" in capsys.readouterr().err
