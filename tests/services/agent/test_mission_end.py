"""A mission of streamed frames ends by EndMission or SIGTERM: drained, handed over, saved, and the next one begins."""

import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from agent_running import TASK, agent, agent_process, cup_options, end
from fusion_running import RunningServer, frame, red_frame
from mapping_scenes import with_box
from uplink_running import uplink
from waiting import wait_until

from gausslite.codec.ply import read_ply
from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.relevance import PointedObject
from gausslite.process import TASK_NOT_FOUND
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.clients import AgentClient
from gausslite.wire.uplink import Uplink
from gausslite_agent.state import EndRequest, MissionState, MissionStateMachine


def state_name(client: AgentClient) -> str:
    return pb.AgentState.Name(client.status().state).removeprefix("AGENT_STATE_")


def test_end_mission_drains_and_a_task_begins_the_next_mission(fusion: RunningServer) -> None:
    with uplink(fusion.client.address) as link, agent(uplink=link, queue_frames=100) as a:
        assert state_name(a.client) == "WAITING_FOR_TASK"
        pytest.raises(MismatchError, a.client.end_mission).match("call AssignTask")
        a.client.assign_task(TASK)
        assert state_name(a.client) == "MAPPING"
        list(a.client.ingest([frame(index) for index in range(6)]))
        ended = a.client.end_mission()
        assert ended == a.client.end_mission()
        assert ended.state == pb.AGENT_STATE_ENDED
        assert (ended.frames_mapped, ended.voxels_waiting, ended.keyframes_waiting) == (6, 0, 0)
        assert ended.summary.startswith("mission ended: 6 frames")
        assert ended.summary.endswith("nothing was left")
        with pytest.raises(MismatchError, match="expected a mission that is mapping, got one that is ended"):
            list(a.client.ingest([frame(6)]))
        a.client.assign_task("Find the chair")
        [answer] = a.client.ingest([frame(7)])
        assert answer.outcome == pb.FRAME_OUTCOME_MAPPED
        assert state_name(a.client) == "MAPPING"
        again = a.client.end_mission()
    assert again.frames_mapped == 7


def test_a_handover_on_request_brings_the_whole_map_and_the_keyframes(fusion: RunningServer) -> None:
    with uplink(fusion.client.address) as link, agent(uplink=link, queue_frames=100) as a:
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(index) for index in range(6)]))
        response = a.client.end_mission(handover=True)
        [stored] = fusion.client.status().agents
        kept = a.worker.run(lambda mapper: mapper.store.kept).result(20)
    assert stored.gaussians == response.gaussians
    assert stored.handover_bytes > 0
    assert stored.keyframes == len(kept) > 0


def test_an_unreachable_server_leaves_data_and_the_summary_says_how_much() -> None:
    with uplink("127.0.0.1:1") as link, agent(uplink=link, queue_frames=100) as a:
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(0)]))
        response = a.client.end_mission(handover=True, drain_s=0.1)
    assert response.state == pb.AGENT_STATE_ENDED
    assert response.voxels_waiting > 0
    assert f"left {response.voxels_waiting} voxels and 0 keyframes, lost when the agent ends" in response.summary


@pytest.mark.parametrize("drain_s", [-1.0, float("nan"), 1e9])
def test_an_impossible_drain_time_is_refused(drain_s: float) -> None:
    pytest.raises(InvalidInputError, EndRequest, False, drain_s).match("drain_seconds")


def test_two_callers_get_the_result_of_one_end(fusion: RunningServer) -> None:
    answers: list[pb.EndMissionResponse] = []
    with uplink(fusion.client.address) as link, agent(uplink=link, queue_frames=100) as a:
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(0)]))
        threads = [threading.Thread(target=lambda: answers.append(a.client.end_mission())) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
    assert len(answers) == 2
    assert answers[0] == answers[1]


def test_calls_that_wait_for_the_end_leave_threads_to_others(
    fusion: RunningServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    drained = threading.Event()
    monkeypatch.setattr(Uplink, "drain", lambda *_: drained.wait(60))
    with uplink(fusion.client.address) as link, agent(uplink=link, queue_frames=100) as a:
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(0)]))
        # more than asyncio's own threads
        calls = [a.stub.EndMission.future(pb.EndMissionRequest()) for _ in range(48)]
        try:
            wait_until(lambda: state_name(a.client) == "DRAINING")
            assert a.stub.GetCameraView(pb.GetCameraViewRequest(), timeout=20).frame_index == 0
        finally:
            drained.set()
        assert len({call.result(20).SerializeToString(deterministic=True) for call in calls}) == 1


def test_a_phase_that_cannot_follow_is_refused() -> None:
    phases = MissionStateMachine()
    pytest.raises(MismatchError, phases.enter, MissionState.ENDED).match("waiting for task, got ended")
    phases.enter(MissionState.MAPPING)
    phases.enter(MissionState.FAILED, "the disk is full")
    assert phases.failure == "the disk is full"
    phases.enter(MissionState.MAPPING)
    assert phases.failure == ""


@pytest.mark.slow
def test_sigterm_hands_over_within_the_grace_period(fusion: RunningServer, tmp_path: Path) -> None:
    options = (*cup_options(tmp_path), "--set", "queue=100", "--fusion", fusion.client.address, "--out", str(tmp_path))
    with agent_process(tmp_path, *options, "--set", "handover=true", "--set", "grace-period=60") as (process, client):
        client.assign_task("Pick up the cup")
        list(client.ingest([red_frame(index) for index in range(12)]))
        log = end(process)
    [stored] = fusion.client.status().agents
    assert "mission ended early (interrupted): 12 frames" in log
    assert "nothing was left" in log
    assert " detections, best score 0.90, " in log
    assert stored.gaussians == len(read_ply(tmp_path / "map.ply")) > 0
    assert stored.handover_bytes > 0
    assert stored.keyframes == 12  # each shows the region


@pytest.mark.slow
def test_what_sigterm_leaves_is_sent_after_the_next_start(fusion: RunningServer, tmp_path: Path) -> None:
    options = ("--set", f"spool={tmp_path / 'x.spool'}", "--state", str(tmp_path / "x.state"), "--set", "handover=true")
    options += (*cup_options(tmp_path), "--set", "queue=100", "--set", "grace-period=0.1")
    with agent_process(tmp_path, *options, "--fusion", "127.0.0.1:1") as (process, client):
        client.assign_task("Pick up the cup")
        list(client.ingest([red_frame(index) for index in range(6)]))
        log = end(process)
    assert "and 6 keyframes, in " in log
    assert "until the agent runs again" in log
    with agent_process(tmp_path, *options, "--fusion", fusion.client.address) as (_, client):
        ended = client.end_mission()
    [stored] = fusion.client.status().agents
    assert (ended.voxels_waiting, ended.keyframes_waiting) == (0, 0)
    assert stored.keyframes == 6
    assert stored.gaussians == ended.gaussians


@pytest.mark.slow
def test_what_is_lost_without_a_spool_is_one_line_and_code_1(tmp_path: Path) -> None:
    options = ("--set", "queue=100", "--set", "grace-period=0.1", "--fusion", "127.0.0.1:1")
    with agent_process(tmp_path, *cup_options(tmp_path), *options) as (process, client):
        client.assign_task("Pick up the cup")
        list(client.ingest([red_frame(index) for index in range(6)]))
        log = end(process, code=1).splitlines()
    (line,) = [line for line in log if " ERROR " in line]
    assert re.search(r"lost [1-9]\d* voxels and 0 keyframes that were not sent; --set spool=FILE keeps them", line)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "code"), [("Pick up the cup", 0), ("Find the chair", TASK_NOT_FOUND)])
def test_an_agent_that_found_nothing_of_its_task_ends_with_a_code_of_its_own(
    tmp_path: Path, task: str, code: int
) -> None:
    with agent_process(tmp_path, *cup_options(tmp_path)) as (process, client):
        client.assign_task(task)
        list(client.ingest([red_frame(index) for index in range(6)]))
        end(process, code=code)


@pytest.mark.slow
def test_a_killed_agent_continues_from_its_last_save(fusion: RunningServer, tmp_path: Path) -> None:
    state = tmp_path / "x.state"
    options = ("--set", f"spool={tmp_path / 'x.spool'}", "--state", str(state), "--set", "save-interval=0.05")
    options += (*cup_options(tmp_path), "--set", "queue=100", "--fusion", fusion.client.address)
    with agent_process(tmp_path, *options) as (process, client):
        client.assign_task("Pick up the cup")
        # the first save may be one before the first frame; a different one is of a map
        saves_ns: set[int] = set()
        for index in range(1000):
            list(client.ingest([red_frame(index)]))
            if state.exists():
                saves_ns.add(state.stat().st_mtime_ns)
            if len(saves_ns) > 1:
                break
        mapped = client.status().map_revision
        process.kill()
    with agent_process(tmp_path, *options) as (_, client):
        status = client.status()
        assert status.graph.text == "Pick up the cup"
        assert state_name(client) == "MAPPING"
        assert status.gaussians > 0
        assert status.map_revision > mapped
        [answer] = client.ingest([red_frame(2000)])
    assert answer.outcome == pb.FRAME_OUTCOME_MAPPED


@pytest.mark.slow
def test_an_agent_without_a_detector_says_so_at_the_start_and_to_assign_task(tmp_path: Path) -> None:
    address = f"unix:{tmp_path}/agent.sock"
    command = [sys.executable, "-m", "gausslite_agent", "--listen", address, "--set", "threads=1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = [process.stderr.readline() for _ in range(2)]
        with AgentClient(address) as client:
            pytest.raises(MismatchError, client.assign_task, TASK).match("--detector")
            assert any("--detector" in note for note in client.status().notes)
        process.terminate()
        assert process.wait(30) == 0
    assert any("every AssignTask will fail" in line and "--detector" in line for line in lines)


@pytest.mark.slow
def test_an_agent_with_a_page_takes_a_task_without_a_detector(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    with agent_process(tmp_path, "--set", "view=0") as (process, client):
        assert client.assign_task(TASK).warnings[0] == "nothing searches 'mug': there is no detector"
        [answer] = client.ingest([with_box(red_frame(0))])
        client.assign_task(pointed=[PointedObject(points_px=((16.0, 12.0),), noun="mug")])
        [pointed_at] = client.ingest([with_box(red_frame(1))])
        end(process)
    assert (answer.roi_share, pointed_at.roi_share > 0) == (0, True)
