"""The commands that reach a running team: status, end, refine and fetch, against real services."""

import json
from pathlib import Path

import pytest
from agent_running import TASK, Agent, agent
from fusion_running import RunningServer, frame
from uplink_running import uplink

from gausslite.cli.main import main
from gausslite.codec.ply import read_ply
from gausslite.domain.relevance import BallRegion
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import TaskRelevanceEstimator


def test_a_team_is_watched_ended_refined_and_fetched(
    fusion: RunningServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server = fusion.client.address
    with uplink(server) as link, agent(uplink=link) as a:
        robot = a.client.address
        assert main(["status", robot]) == 0
        assert capsys.readouterr().out.startswith("agent robot: waiting for task\n")
        a.client.assign_task(TASK)
        list(a.client.ingest([frame(0)]))
        assert main(["status", robot, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["frames_mapped"] == "1"
        assert main(["end", robot, "--handover"]) == 0
        assert capsys.readouterr().out.strip().endswith("nothing was left")
    assert main(["status", server]) == 0
    out = capsys.readouterr().out
    assert "keyframes  1; not refined yet" in out
    assert "robot      absent, heard " in out
    assert "received since the server's start: " in out
    refined, voted = tmp_path / "refined.ply", tmp_path / "voted.ply"
    assert main(["refine", server, "--iterations", "2", "--out", str(refined)]) == 0
    capsys.readouterr()
    assert main(["refine", server, "--iterations", "2"]) == 0
    assert f"get it with: gausslite fetch {server} --strategy refined --out refined.ply" in capsys.readouterr().out
    assert main(["fetch", server, "--out", str(voted)]) == 0
    assert main(["fetch", server, "--strategy", "refined", "--out", str(tmp_path / "again.ply")]) == 0
    assert len(read_ply(refined)) == len(read_ply(tmp_path / "again.ply")) > 0
    assert len(read_ply(voted)) > 0


def test_the_status_of_an_agent_that_has_not_found_its_task_exits_with_3() -> None:
    mug = RegionDetector({"mug_1": BallRegion((0.0, 0.0, 1.2), 0.2)})
    with agent(lambda graph: TaskRelevanceEstimator(graph, mug)) as a:
        robot = a.client.address
        assert a.client.assign_task("Find the unicorn").warnings == (
            "no region matches 'unicorn'; the regions are mug_1",
        )
        assert main(["status", robot]) == 0  # it has seen nothing yet
        list(a.client.ingest([frame(0)]))
        assert main(["status", robot]) == 3


def test_errors_are_one_line(
    fusion: RunningServer, robot: Agent, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, expected in (
        (["end", robot.client.address], "call AssignTask"),
        (["status", "nowhere.invalid:1"], "nowhere.invalid:1: "),
        (["status", "nowhere"], "address: expected HOST:PORT or unix:PATH, got 'nowhere'"),
        (["status", ""], "address: expected HOST:PORT or unix:PATH, got ''"),
        (["end", "nowhere"], "gausslite: address of the agent: expected HOST:PORT or unix:PATH, got 'nowhere'"),
        (["fetch", "http://host:1", "--out", str(tmp_path / "x.ply")], "expected HOST:PORT without http://, got"),
        (["objects", str(tmp_path / "none")], "no such folder; a fusion server or an agent: expected HOST:PORT"),
        (["end", fusion.client.address], "another service listens there"),
        (["fetch", robot.client.address, "--out", str(tmp_path / "x.ply")], "another service listens there"),
        (["fetch", fusion.client.address, "--out", str(tmp_path / "x.ply")], "the map is empty: the server has no"),
        (["fetch", fusion.client.address, "--strategy", "refined", "--out", str(tmp_path / "x.ply")], "refine"),
        (["refine", fusion.client.address, "--out", "/dev/null/x"], "/dev/null"),
    ):
        assert main(arguments) == 2
        [line] = capsys.readouterr().err.splitlines()[-1:]
        assert expected in line
    assert not (tmp_path / "x.ply").exists()
