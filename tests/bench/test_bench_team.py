"""The team benchmark: a small home with two agents, and wrong frames."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import wall_frame
from place_scenes import room
from tiny_sequences import write_seven_scenes

from gausslite.cli.main import main
from gausslite.domain.pose import rotation_angle_deg, translation_m
from gausslite_bench.team.frame_errors import FrameError
from gausslite_bench.team.missions import AgentMap
from gausslite_bench.team.scenes import AgentScene, HomeTeamPlan


def test_a_team_is_mapped_fused_and_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ("--size", "80x60", "--frames", "4", "--views", "2", "--max-gaussians", "3000", "--iterations", "2")
    arguments = ("bench", "team", "--homes", "4", "--policies", "task,uniform", "--refine-iterations", "3")
    assert main([*arguments, *size, "--threads", "1", "--json", "--out", str(tmp_path)]) == 0
    task, uniform = json.loads(capsys.readouterr().out)["trials"]
    assert set(task["roi_psnr"]) == {
        "concatenation",
        "vote",
        "vote of shared regions",
        "refine",
        "agent-0 alone",
        "agent-1 alone",
    }
    assert all(5 < value < 60 for value in task["full_psnr"].values())
    assert task["alignment"]["agent-0"] == "reference"
    assert 0 < task["share_percent"] < 100
    assert task["bytes_sent"] > 0
    # a policy without a task has no region to send
    assert uniform["share_percent"] == 0
    assert (tmp_path / "team.md").read_text().count("| home-4 x 2 |") == 12


def test_four_agents_of_a_home_see_different_views() -> None:
    scene = HomeTeamPlan(4, agents=4, frames=6, views=1).load((32, 24))
    walks = [np.array([frame.T_world_camera for frame in agent.frames]) for agent in scene.agents]
    assert [agent.task for agent in scene.agents[:3]] != [scene.agents[0].task] * 3
    for first, second in itertools.combinations(walks, 2):
        distances_m = np.linalg.norm(first[:, None, :3, 3] - second[None, :, :3, 3], axis=-1)
        assert np.median(distances_m.min(axis=1)) > 0.01


def test_a_late_robot_is_measured_alone_and_with_the_teams_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = ("--size", "160x120", "--frames", "8", "--views", "4", "--max-gaussians", "6000", "--iterations", "2")
    arguments = ("bench", "team", "--late-joiner", "--homes", "4", "--policies", "task", "--json")
    assert main([*arguments, *size, "--threads", "1", "--out", str(tmp_path)]) == 0
    [scene] = json.loads(capsys.readouterr().out)["scenes"]
    assert [count for count, _ in scene["alone"]] == [1, 2, 4, 8]
    assert scene["with_team"][0][1] > scene["alone"][0][1]
    assert 0 < scene["team_bytes"] < 100_000


def test_positions_of_objects_are_compared_with_ground_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = ("--size", "160x120", "--frames", "12", "--views", "4", "--threads", "1")
    assert main(["bench", "team", "--positions", "--homes", "4", *size, "--json", "--out", str(tmp_path)]) == 0
    alone, team = json.loads(capsys.readouterr().out)["scenes"]
    assert (alone["agents"], team["agents"]) == (1, 2)
    for each in (alone, team):
        [error_m] = each["errors_m"]
        assert error_m < 0.05
        assert each["others"] == 0
    assert "| home-4 x 2 |" in (tmp_path / "positions.md").read_text()


def test_frames_of_pairs_are_judged_without_a_false_alarm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ("--size", "160x120", "--frames", "16", "--views", "1", "--max-gaussians", "15000", "--iterations", "2")
    arguments = ("bench", "team", "--frame-pairs", "80", "--homes", "1", "--policies", "uniform", "--threads", "1")
    assert main([*arguments, *size, "--json", "--out", str(tmp_path)]) == 0
    pairs = json.loads(capsys.readouterr().out)["scenes"]
    outcomes = {error: [pair["outcome"] for pair in pairs if pair["error"] == error] for error in ("none", "gross")}
    assert len(outcomes["none"]) == 40
    assert set(outcomes["none"]) <= {"fits", "not compared"}
    assert outcomes["none"].count("fits") >= 10
    compared = [outcome for outcome in outcomes["gross"] if outcome != "not compared"]
    assert compared.count("contradicted") >= 0.8 * len(compared) > 5
    assert "| whole | gross |" in (tmp_path / "frame-pairs.md").read_text()


def test_the_frame_of_a_second_map_is_found_from_anywhere_and_no_wrong_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("kiss_matcher")
    gaussians = room(0)

    def map_half(agent: AgentScene, *_: object) -> AgentMap:
        half = gaussians.take(np.arange(int(agent.agent_id[-1]), len(gaussians), 2))
        return AgentMap(agent.agent_id, half, (), (), bytes_sent=0, gaussians_sent=0, bytes_whole=0)

    monkeypatch.setattr("gausslite_bench.cli.team.map_agent", map_half)
    arguments = ("bench", "team", "--unknown-frames", "1", "--policies", "uniform", "--size", "16x16", "--frames", "2")
    assert main([*arguments, "--views", "1", "--json", "--out", str(tmp_path)]) == 0
    searches = json.loads(capsys.readouterr().out)["scenes"]
    outcomes = {(search["place"], search["outcome"]) for search in searches}
    assert {place for place, outcome in outcomes if outcome == "aligned"} - {"part of it"} == {"same scene"}
    assert ("mirrored scene", "abstained") in outcomes
    assert "wrong" not in {outcome for _, outcome in outcomes}
    assert max(search["error_m"] for search in searches if search["outcome"] == "aligned") < 0.03
    assert "| same scene | voxels | 1 | 1 | 0 | 0 |" in (tmp_path / "unknown-frames.md").read_text()


def test_parts_of_a_recording_make_a_team(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_seven_scenes(tmp_path / "wall", tuple(range(18)))
    voxels = np.stack(np.meshgrid(range(-4, 4), range(-4, 4), [19, 20], indexing="ij"), axis=-1).reshape(-1, 3)
    np.savez(folder / "roi_voxels.npz", voxel_size_m=0.1, cup_1=voxels.astype(np.int32))
    source = ["--real", str(folder), "--size", "24x18", "--pose-prior", "none", "--no-fit-views"]
    budget = ["--max-gaussians", "300", "--iterations", "2", "--refine-iterations", "2", "--threads", "1"]
    arguments = ["bench", "team", *source, *budget, "--policies", "task", "--json", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    [trial] = json.loads(capsys.readouterr().out)["trials"]
    assert trial["scene"] == "wall-cup x 2"
    assert 5 < trial["roi_psnr"]["vote"] < 60
    assert set(trial["alignment"]) == {"agent-0", "agent-1"}


def test_a_frame_error_shifts_turns_and_drifts() -> None:
    frames = [wall_frame(i, shift_m=2.0 * i) for i in range(3)]
    assert FrameError().apply(frames) == frames
    shifted = FrameError(shift_m=0.05).apply(frames)
    turned = FrameError(rotation_deg=2.0).apply(frames)
    drifting = FrameError(drift=0.01).apply(frames)
    for i, frame in enumerate(frames):
        pose = frame.T_world_camera
        assert translation_m(pose, shifted[i].T_world_camera) == pytest.approx(0.05)
        assert rotation_angle_deg(pose, turned[i].T_world_camera) == pytest.approx(2.0)
        assert translation_m(pose, drifting[i].T_world_camera) == pytest.approx(0.02 * i)
    assert translation_m(frames[0].T_world_camera, turned[0].T_world_camera) == pytest.approx(0.0)
