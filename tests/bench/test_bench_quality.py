"""The quality benchmark on one small home: tasks, trial keys, cached results and tables."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from quality_results import CONDITIONS, PLAN, TASK, UNIFORM, finished

from gausslite.cli.main import main
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mapping.policies import POLICIES
from gausslite.nouns import same_kind
from gausslite_bench.quality.growth import curves, growth_plot, growth_table
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import choose_home_tasks, home_tasks
from gausslite_bench.quality.real_scenes import RealScenePlan
from gausslite_bench.quality.study import FinishedTrial, Study, run_study
from gausslite_bench.quality.tables import (
    FULL_PSNR,
    ROI_PSNR,
    StudyResults,
    ablation_table,
    quality_table,
)
from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_bench.quality.trials import (
    BudgetMode,
    Conditions,
    Trial,
    TrialBudget,
    Variant,
    build_map,
    cumulative_variants,
)
from gausslite_language.rules import RuleParser
from gausslite_sim.home_catalogue import HOME_COUNT, HOMES


def test_each_home_has_one_task_of_each_kind() -> None:
    kinds = {(home, kind) for home in range(1, HOME_COUNT + 1) for kind in ("manipulation", "search", "navigation")}
    assert {(pair.home, pair.kind) for pair in home_tasks()} == kinds
    assert len({pair.task for pair in home_tasks()}) == len(home_tasks()) == 24


def test_the_targets_of_each_task_match_its_objects() -> None:
    for pair in home_tasks():
        graph = RuleParser().parse(pair.task)
        assert not graph.warnings, pair.name
        for name in pair.objects:
            assert any(same_kind(target, name) for target in graph.targets), (pair.name, graph.targets, name)


def test_the_objects_of_a_task_exist_in_its_home() -> None:
    names = {item.name for item in HOMES[PLAN.pair.home - 1].furnish(np.random.default_rng(0))}
    for pair in choose_home_tasks([f"home-{PLAN.pair.home}"]):
        assert set(pair.objects) <= names


def test_tasks_are_selected_by_name_or_home() -> None:
    assert choose_home_tasks([]) == home_tasks()
    assert [pair.name for pair in choose_home_tasks(["home-2", "home-5-search"])] == [
        "home-2-manipulation",
        "home-2-search",
        "home-2-navigation",
        "home-5-search",
    ]
    with pytest.raises(InvalidInputError, match=r"pairs: expected names such as home-3 .*, got home-9"):
        choose_home_tasks(["home-1", "home-9"])


def test_components_are_enabled_one_by_one() -> None:
    variants = cumulative_variants()
    label_textures = [variant.label for variant in variants]
    views = ["+long-term-keyframes", "+roi-context", "+depth-edge-mask"]
    others = ["+depth-fill", "+background-reserve", "+ema", "+lr-decay", "+saturation"]
    training = ["+motion-mask", "+view-rotation", "+active-views", "+half-size"]
    assert label_textures == ["none", "+SB", "+MVO", "+ROI", "+SIS", "+GFD", *views, *others, *training]
    off = [variant.disabled for variant in variants]
    assert all(len(a - b) == 1 and b < a for a, b in pairwise(off))
    assert not off[-1]


def test_a_trials_key_changes_with_each_of_its_settings() -> None:
    trial = Trial(PLAN, TASK, TrialBudget(), 0, CONDITIONS)
    others = [
        replace(trial, seed=1),
        replace(trial, conditions=Conditions((64, 48))),
        replace(trial, variant=UNIFORM),
        replace(trial, budget=TrialBudget(iterations=9)),
        replace(trial, budget=TrialBudget(equal=BudgetMode.TIME)),
        replace(trial, plan=replace(PLAN, frames=5)),
        replace(trial, plan=HomeScenePlan(choose_home_tasks(["home-8-search"])[0], 4, 3)),
    ]
    assert len({each.key for each in (trial, *others)}) == 1 + len(others)
    assert trial.key == Trial(PLAN, TASK, TrialBudget(), 0, CONDITIONS).key


def test_a_map_without_a_task_is_shared_by_all_tasks_of_a_home() -> None:
    search = HomeScenePlan(choose_home_tasks(["home-8-search"])[0], 4, 3)
    trial, other_task = (
        Trial(PLAN, UNIFORM, TrialBudget(), 0, CONDITIONS),
        Trial(search, UNIFORM, TrialBudget(), 0, CONDITIONS),
    )
    assert (trial.map_key, trial.follows_task) == (other_task.map_key, False)
    for other in (
        replace(trial, seed=1),
        replace(trial, budget=TrialBudget(iterations=9)),
        replace(trial, plan=replace(PLAN, frames=5)),
        replace(trial, plan=HomeScenePlan(choose_home_tasks(["home-7-search"])[0], 4, 3)),
        replace(trial, variant=Variant("monogs", "monogs")),
    ):
        assert other.map_key != trial.map_key
    with_task = Trial(PLAN, TASK, TrialBudget(), 0, CONDITIONS)
    assert with_task.follows_task
    assert with_task.map_key != Trial(search, TASK, TrialBudget(), 0, CONDITIONS).map_key
    assert not replace(with_task, variant=cumulative_variants()[0]).follows_task


def test_homes_have_exact_poses_and_real_sequences_a_pose_prior(tmp_path: Path) -> None:
    assert not Trial(PLAN, TASK, TrialBudget(), 0, CONDITIONS).mission.pose_prior.has_pose_error
    real = RealScenePlan(tmp_path, tmp_path / "roi.npz", "mug", ("mug_1",))
    mission = Trial(real, UNIFORM, TrialBudget(), 0, CONDITIONS).mission
    assert PoseExposurePrior.parse(str(mission.pose_prior)) == PoseExposurePrior(0.01, 0.5, 0.1, 0.03)


def test_a_trials_key_is_the_same_in_every_process() -> None:
    program = (
        "from gausslite_bench.quality.home_tasks import home_tasks\n"
        "from gausslite_bench.quality.home_scenes import HomeScenePlan\n"
        "from gausslite_bench.quality.trials import TrialBudget, Conditions, Trial, cumulative_variants\n"
        "for variant in cumulative_variants():\n"
        "    print(Trial(HomeScenePlan(home_tasks()[0]), variant, TrialBudget(), 0, Conditions((96, 72))).key)\n"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    other = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True, text=True)
    plan, conditions = HomeScenePlan(home_tasks()[0]), Conditions((96, 72))
    keys = [Trial(plan, variant, TrialBudget(), 0, conditions).key for variant in cumulative_variants()]
    assert other.stdout.split() == keys
    assert len(set(keys)) == len(cumulative_variants())


def test_results_have_means_spreads_and_margins() -> None:
    budget = TrialBudget()
    results = StudyResults(
        [finished(*each, budget) for each in ((TASK, 0, 26.0), (TASK, 1, 28.0), (UNIFORM, 0, 24.5), (UNIFORM, 1, 24.5))]
    )
    assert results.values(PLAN.name, "task", ROI_PSNR, budget) == [26.0, 28.0]
    assert results.mean([PLAN.name], "task", FULL_PSNR, budget) == 20.0
    assert results.margin(PLAN.name, ROI_PSNR, budget) == pytest.approx(2.5)
    table = quality_table(results)
    for text in (
        "| task | 27.00 | 0.800 | – | 2.00 | 93.8 | 20.00 | 0.700 | – | 8.0 | 12 | 900 | 8 |",
        "| 1.1% in 2 of 3 views | 27.00 ± 1.00 | 24.50 ± 0.00 | +2.50 | +0.00 |",
        "`task` exceeds the best other policy in 1 of 1, by +2.50 dB in the mean.",
    ):
        assert text in table
    assert [trial["seed"] for trial in results.trials_as_json()] == [0, 1, 0, 1]


def test_the_ablation_table_has_one_row_per_component_and_both_budgets() -> None:
    budgets = [TrialBudget(equal=equal) for equal in BudgetMode]
    results = StudyResults([finished(v, 0, 20.0 + i, b) for b in budgets for i, v in enumerate(cumulative_variants())])
    table = ablation_table(results)
    one = "25.00 | 20.00"
    assert f"| +GFD | {one} | {one} |" in table
    assert "ROI PSNR↑, equal time" in table


def test_a_curve_that_falls_is_named() -> None:
    steps = {"8": 26.0, "32": 26.5, "128": 25.9}
    budgets = [TrialBudget(iterations=int(step)) for step in steps]
    one_study = [finished(TASK, 0, own, budget) for own, budget in zip(steps.values(), budgets, strict=True)]
    found = curves([(StudyResults(one_study), budget) for budget in budgets])
    assert [(curve.metric, curve.falls) for curve in found] == [(ROI_PSNR.title, True), (FULL_PSNR.title, False)]
    table = growth_table("iterations", list(steps), found)
    assert "| 26.00 | 26.50 | 25.90 | **0.60** |" in table
    assert "1 of 2 curves fall by more than 0.1 dB in a step." in table
    assert growth_plot(list(steps), found).count("<polyline") == len(found)


def test_each_policy_has_its_curve_and_colour() -> None:
    budget = TrialBudget()
    results = StudyResults([finished(Variant(name, name), 0, 20.0, budget) for name in POLICIES])
    plot = growth_plot(["8"], curves([(results, budget)]))
    colours = re.findall(r'<polyline.*stroke="(#\w+)"', plot)
    assert len(set(colours)) == len(POLICIES) == 6
    assert len(colours) == 2 * len(POLICIES)


@pytest.mark.slow
def test_the_command_computes_caches_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "4", "--views", "3"]
    budget = ["--max-gaussians", "1500", "--iterations", "2", "--threads", "1"]
    command = ["bench", "quality", "--out", str(tmp_path), "--policies", "task,uniform", *options, *budget]
    assert main(command) == 0
    first = capsys.readouterr()
    assert "`task` exceeds" in first.out
    report = json.loads((tmp_path / "quality.json").read_text())
    assert [each["variant"] for each in report["trials"]] == ["task", "uniform"]
    assert {each["task"] for each in report["trials"]} == {"Prepare to pick up the drill on the workbench"}
    assert all(each["cost"]["gaussians"] <= 1500 for each in report["trials"])
    assert main(command) == 0
    again = capsys.readouterr()
    assert again.err.count("(cached)") == 2
    assert json.loads((tmp_path / "quality.json").read_text())["trials"] == report["trials"]
    next((tmp_path / "trials").glob("home-8-manipulation-task-*.json")).unlink()
    assert main([*command, "--seeds", "0,1"]) == 0
    assert capsys.readouterr().err.count("(cached)") == 1


def test_a_task_independent_map_is_built_once_for_all_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    built = []
    monkeypatch.setattr(
        "gausslite_bench.quality.study.build_map", lambda trial, scene: built.append(trial) or build_map(trial, scene)
    )
    plans = [HomeScenePlan(pair, frames=4, views=3) for pair in choose_home_tasks(["home-8"])]
    conditions = Conditions((96, 72), threads=1)
    together = Study(plans, [TASK, UNIFORM], [TrialBudget(max_gaussians=1500, iterations=1)], [0], conditions)
    results = list(run_study(together, TrialCache(tmp_path / "together"), None))
    assert [frame.index for frame in plans[0].load((96, 72)).training] == [0, 1, 2, 3]
    assert len(built) == 3 + 1
    alone = replace(together, plans=plans[2:], variants=[UNIFORM])
    [last] = run_study(alone, TrialCache(tmp_path / "alone"), None)
    assert isinstance(last, FinishedTrial)
    assert isinstance(results[-1], FinishedTrial)
    assert results[-1].trial.key == last.trial.key
    assert results[-1].result.scores == last.result.scores


@pytest.mark.slow
def test_the_ablation_uses_the_requested_budget(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pair", "home-8-manipulation", "--size", "96x72", "--frames", "2", "--views", "2", "--seeds", "0"]
    budget = ["--equal", "time", "--rate", "200", "--max-gaussians", "500", "--threads", "1"]
    assert main(["bench", "ablation", "--out", str(tmp_path), *options, *budget]) == 0
    report = json.loads((tmp_path / "ablation.json").read_text())
    budgets = {(each["budget"]["equal"], each["budget"]["rate_hz"]) for each in report["trials"]}
    assert budgets == {("time", 200.0)}
    assert len(report["trials"]) == len(cumulative_variants())


@pytest.mark.slow
def test_a_growing_quantity_has_a_table_and_a_plot(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "4", "--views", "2", "--steps", "1,2"]
    main(["bench", "compute", "--out", str(tmp_path), *options, "--max-gaussians", "500", "--threads", "1"])
    report = json.loads((tmp_path / "compute.json").read_text())
    assert [each["budget"]["iterations"] for each in report["trials"]] == [1, 1, 2, 2]
    assert "<polyline" in (tmp_path / "compute.svg").read_text()
