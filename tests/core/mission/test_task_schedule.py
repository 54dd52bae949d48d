"""The schedule of a mission's tasks, and `map` with a task that changes."""

import json
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.mission.schedule import TaskSchedule
from gausslite_language.rules import RuleParser


def test_the_current_task_is_that_of_the_latest_switch() -> None:
    parse = RuleParser().parse
    first, second, third = parse("Find the mug"), parse("Find the bowl"), parse("Find the chair")
    plan = TaskSchedule(first, ((20, third), (10, second)))
    assert [plan.at(frame) for frame in (0, 9, 10, 19, 20, 99)] == [first, first, second, second, third, third]
    assert TaskSchedule.parse(second, ["20:Find the chair", "10: Find the mug "], RuleParser()) == TaskSchedule(
        second, ((20, third), (10, first))
    )


@pytest.mark.parametrize("text", ["Find the mug", "x:Find the mug", "7:", "-1:Find the mug"])
def test_an_invalid_task_switch_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["map", "sim:home?frames=2", "--task", "Find the mug", "--set", f"task-at={text}", "--out", str(tmp_path)]
    assert main(command) == 2
    assert "task-at" in capsys.readouterr().err


@pytest.mark.slow
def test_a_mission_with_a_task_change_resumes_bit_identically(tmp_path: Path) -> None:
    def map_home(name: str, *more: str) -> tuple[bytes, dict[str, object]]:
        common = ["--size", "64x48", "--max-gaussians", "500", "--iterations", "2", "--set", "threads=1"]
        tasks = ["--task", "Pick up the mug on the table", "--set", "task-at=6:Find the chair"]
        out = str(tmp_path / name)
        assert main(["map", "sim:home?seed=0&trajectory=0&frames=14", *common, *tasks, "--out", out, *more]) == 0
        report = json.loads((tmp_path / name / "report.json").read_text())
        return (tmp_path / name / "map.ply").read_bytes(), report

    state = str(tmp_path / "run.state")
    uninterrupted, report = map_home("uninterrupted")
    # all six earlier frames showed the first task's region, so they are keyframes
    assert report["keyframes_reevaluated"] == 6
    map_home("first", "--frames", "0:7", "--set", f"save-state={state}")
    assert map_home("rest", "--set", f"resume={state}")[0] == uninterrupted
