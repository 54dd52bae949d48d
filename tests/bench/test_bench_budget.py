"""The benchmark of budgets: points, gains, the table, and the command on a tiny home."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from quality_results import TASK, UNIFORM, finished

from gausslite.cli.main import main
from gausslite_bench.quality.budget import BudgetAxes, budget_curves, budget_table, task_gain

AXES = BudgetAxes(caps=(60_000, 15_000), sizes=((320, 240),), iterations=(8, 4, 16))


def test_one_budget_varies_at_a_time() -> None:
    points = AXES.points()
    assert list(points) == ["Gaussians", "iterations"]
    assert [point.max_gaussians for point in points["Gaussians"]] == [15_000, 60_000]
    assert [point.iterations for point in points["iterations"]] == [4, 8, 16]
    assert {point.max_gaussians for point in points["iterations"]} == {60_000}
    assert len(AXES.all_points()) == 4  # the common point once


def test_the_gain_is_the_mean_over_seeds_with_their_spread() -> None:
    budget = AXES.all_points()[0].trial_budget
    trials = [finished(TASK, 0, 24.0, budget), finished(TASK, 1, 26.0, budget)]
    trials += [finished(UNIFORM, 0, 23.0, budget), finished(UNIFORM, 1, 23.0, budget)]
    gain = task_gain(trials)
    assert gain is not None
    assert (gain.roi, gain.roi_spread, gain.full, gain.worst_scene) == (2.0, 1.0, 0.0, 2.0)
    assert gain.roi_psnr == 26.0  # with fitted views, one decibel above the raw figures
    assert gain.ms == (12.5, 12.5)


def test_the_table_and_the_curves_show_the_measured_points() -> None:
    point = AXES.all_points()[0]
    gain = task_gain([finished(TASK, 0, 24.0, point.trial_budget), finished(UNIFORM, 0, 23.5, point.trial_budget)])
    assert gain is not None
    assert "+0.50 ± 0.00" in budget_table(AXES, {point: gain})
    shown = [line for curves in budget_curves(AXES, {point: gain}).values() for line in curves["region"]]
    assert [y for _, y in shown] == [0.5] * len(shown)
    assert shown


def test_the_command_writes_table_and_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--pairs", "home-8-manipulation", "--frames", "3", "--views", "2", "--seeds", "0", "--threads", "1"]
    budgets = ["--caps", "600,300", "--sizes", "64x48", "--iterations", "2"]
    assert main(["bench", "budget", "--out", str(tmp_path), *arguments, *budgets]) == 0
    points = json.loads((tmp_path / "budget.json").read_text())["points"]
    assert {point["max_gaussians"] for point in points} <= {300, 600}
    table = (tmp_path / "budget.md").read_text()
    assert "| Gaussians | " in table or not points
    assert "budget.md" in capsys.readouterr().out
