"""The benchmark of task changes with its table and plot, and `map --task-at` on a tiny home."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from gausslite.cli.main import main
from gausslite.mission.schedule import TaskSchedule, TaskSwitch
from gausslite.mission.settings import MissionSettings
from gausslite.task.rules import RuleParser
from gausslite_bench.plots import write_curves
from gausslite_bench.task_change import (
    ALWAYS,
    CHANGED,
    RESTARTED,
    Recovery,
    TaskChange,
    TaskChangeBench,
    recovery_table,
)

CHANGE = TaskChange.parse("home-8-navigation:home-8-search")


def recovery(gaps_db: list[float]) -> Recovery:
    seconds = [0.25, 5.0, 10.0, 11.0]
    changed = [(when, 20.0 - gap) for when, gap in zip(seconds, gaps_db, strict=True)]
    always = [(when, 20.0) for when in seconds]
    return Recovery(CHANGE, {CHANGED: changed, RESTARTED: changed, ALWAYS: always}, 4, 2, 100, 50)


def test_a_map_has_recovered_if_the_gap_stays_below_the_goal() -> None:
    assert recovery([3.0, 0.9, 1.1, 0.5]).recovered_s == 11.0
    assert recovery([0.1, 0.9, 0.1, 0.5]).recovered_s == 0.25
    assert recovery([3.0, 0.9, 0.1, 1.5]).recovered_s is None
    assert recovery([3.0, 0.9, 0.4, 1.5]).gap_db(2) == pytest.approx(0.4)
    assert "| 17.00 → 19.60 | 17.00 → 19.60 | 20.00 → 20.00 | 0.40 | never |" in recovery_table(
        [recovery([3.0, 0.9, 0.4, 1.5])]
    )


def test_the_three_maps_get_the_same_frames_after_the_change() -> None:
    settings = MissionSettings(max_gaussians=2000, iterations=2, threads=1)
    bench = TaskChangeBench(settings, before=3, after=3, views=3, size=(96, 72), check_every=2)
    recovery = bench.run(CHANGE)
    assert set(recovery.points) == {CHANGED, RESTARTED, ALWAYS}
    assert all([when for when, _ in line] == [0.25, 0.5, 0.75] for line in recovery.points.values())
    # all three frames before the change are views, with and without the first task's region
    assert recovery.reevaluated == recovery.max_reevaluated == 3
    json.dumps(recovery.as_json())


def test_the_first_and_the_last_frame_are_scored() -> None:
    settings = MissionSettings(max_gaussians=500, iterations=1, threads=1)
    recovery = TaskChangeBench(settings, before=1, after=4, views=3, size=(64, 48)).run(CHANGE)
    assert all([when for when, _ in line] == [0.25, 1.0] for line in recovery.points.values())


def plot(path: Path, panels: dict[str, dict[str, list[tuple[float, float]]]]) -> np.ndarray:
    write_curves(path, panels, "seconds", "dB")
    return cv2.imread(str(path))


def test_a_single_point_is_visible_in_the_plot(tmp_path: Path) -> None:
    image = plot(tmp_path / "plot.png", {"a": {"line": [(0.25, 20.0)]}})
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 4


def test_without_matplotlib_the_error_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["bench", "task-change", "--out", str(tmp_path / "out")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "pip install 'gausslite[plots]'" in line
    assert not (tmp_path / "out").exists()


def test_the_current_task_is_that_of_the_latest_switch() -> None:
    parse = RuleParser().parse
    first, second, third = parse("Find the mug"), parse("Find the bowl"), parse("Find the chair")
    plan = TaskSchedule(first, ((20, third), (10, second)))
    assert [plan.at(frame) for frame in (0, 9, 10, 19, 20, 99)] == [first, first, second, second, third, third]
    assert TaskSwitch.parse("7: Find the mug ") == TaskSwitch(7, "Find the mug")


@pytest.mark.parametrize("text", ["Find the mug", "x:Find the mug", "7:", "-1:Find the mug"])
def test_an_invalid_task_switch_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["map", "sim:home?frames=2", "--task", "Find the mug", "--set", f"task-at={text}", "--out", str(tmp_path)]
    assert main(command) == 2
    assert "task-at" in capsys.readouterr().err


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
    assert report["keyframes_reread"] == 6
    map_home("first", "--frames", "0:7", "--set", f"save-state={state}")
    assert map_home("rest", "--set", f"resume={state}")[0] == uninterrupted
