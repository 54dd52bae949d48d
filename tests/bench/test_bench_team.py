"""The team benchmark: a small home with two agents, and a recording in two parts."""

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from quality_results import scores
from tiny_sequences import write_replica, write_seven_scenes

from gausslite.cli.main import main
from gausslite_bench.quality.real_scenes import real_plans
from gausslite_bench.quality.scenes import UnseenRegionError
from gausslite_bench.team.bench import CONCATENATION, VOTE, TeamResult
from gausslite_bench.team.scenes import HomeTeamPlan, RecordingTeamPlan
from gausslite_bench.team.tables import team_table


@pytest.mark.slow
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
    walks = [np.array([frame.T_world_camera for frame in agent.training]) for agent in scene.values()]
    assert len({agent.task for agent in scene.values()}) > 1
    for first, second in itertools.combinations(walks, 2):
        distances_m = np.linalg.norm(first[:, None, :3, 3] - second[None, :, :3, 3], axis=-1)
        assert np.median(distances_m.min(axis=1)) > 0.01


def test_an_unmeasured_region_is_no_measured_one_of_0_db() -> None:
    def result(seed: int, roi_psnr: float | None) -> TeamResult:
        of_region = scores(roi_psnr) if roi_psnr else dataclasses.replace(scores(None), roi_ssim=None)
        return TeamResult("home", "task", seed, {CONCATENATION: of_region, VOTE: of_region}, 1.0, 1, 1, 1, 1, {})

    assert "| vote | – | – | – | 20.00 |" in team_table([result(0, None)])
    assert "| vote | 24.00 | +0.00 | 0.800 | 20.00 |" in team_table([result(0, None), result(1, 24.0)])


def test_one_robot_of_a_team_may_not_see_the_region(tmp_path: Path) -> None:
    robots = [write_replica(tmp_path / f"part{i}", 9) for i in (1, 2)]
    voxels = np.stack(np.meshgrid(range(-4, 4), range(-4, 4), [9, 10], indexing="ij"), axis=-1).reshape(-1, 3)
    np.savez(tmp_path / "roi.npz", voxel_size_m=0.1, cup_1=voxels.astype(np.int32))
    plans = tuple(real_plans(robot, tmp_path / "roi.npz")[0] for robot in robots)
    team, elsewhere = RecordingTeamPlan(plans[:1], recordings=plans), "1 0 0 99 0 1 0 0 0 0 1 0 0 0 0 1\n" * 9
    (robots[1] / "traj.txt").write_text(elsewhere)
    assert [view.shows_region for view in team.load((24, 18))["agent-1"].held_out] == [True, False]
    (robots[0] / "traj.txt").write_text(elsewhere)
    with pytest.raises(UnseenRegionError, match="at least 64 pixels of cup_1 at 24x18, got none of 2"):
        team.load((24, 18))


@pytest.mark.slow
def test_parts_of_a_recording_make_a_team(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_seven_scenes(tmp_path / "wall", tuple(range(18)))
    voxels = np.stack(np.meshgrid(range(-4, 4), range(-4, 4), [19, 20], indexing="ij"), axis=-1).reshape(-1, 3)
    np.savez(folder / "roi_voxels.npz", voxel_size_m=0.1, cup_1=voxels.astype(np.int32))
    source = ["--real", str(folder), "--size", "24x18"]
    budget = ["--max-gaussians", "300", "--iterations", "2", "--refine-iterations", "2", "--threads", "1"]
    arguments = ["bench", "team", *source, *budget, "--policies", "task", "--json", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    [trial] = json.loads(capsys.readouterr().out)["trials"]
    assert trial["scene"] == "wall-cup x 2"
    assert 5 < trial["roi_psnr"]["vote"] < 60
    assert set(trial["alignment"]) == {"agent-0", "agent-1"}


@pytest.mark.slow
def test_a_folder_of_recordings_in_replicas_layout_is_a_team(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robots = [write_replica(tmp_path / "Office-0" / f"office_0_part{i}", 9) for i in (1, 2)]
    voxels = np.stack(np.meshgrid(range(-4, 4), range(-4, 4), [9, 10], indexing="ij"), axis=-1).reshape(-1, 3)
    np.savez(robots[0].parent / "roi_voxels.npz", voxel_size_m=0.1, cup_1=voxels.astype(np.int32))
    budget = ["--max-gaussians", "300", "--iterations", "2", "--refine-iterations", "2", "--threads", "1"]
    arguments = ["bench", "team", "--real", str(robots[0].parent), "--size", "24x18", *budget]
    assert main([*arguments, "--policies", "task", "--json", "--out", str(tmp_path / "out")]) == 0
    [trial] = json.loads(capsys.readouterr().out)["trials"]
    assert trial["scene"] == "office_0_part1-cup x 2"
    assert trial["roi_psnr"]["vote"] > 5
