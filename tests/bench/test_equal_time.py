"""At equal time a study is paced by uniform mapping once, unless it is told a rate."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from quality_results import CONDITIONS, PLAN, TASK

from gausslite.cli.main import main
from gausslite.errors import InvalidInputError
from gausslite_bench.quality.equal_time import kept_rate, pacing_trials
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import BudgetMode, TrialBudget

TIMED = TrialBudget(equal=BudgetMode.TIME)


def study(*budgets: TrialBudget) -> Study:
    return Study([PLAN], [TASK], budgets, [0], CONDITIONS)


def test_only_time_that_nobody_measured_needs_a_pace() -> None:
    told = TrialBudget(equal=BudgetMode.TIME, rate_hz=7.0)
    assert pacing_trials(study(TrialBudget(), told)) == []
    [trial] = pacing_trials(study(TrialBudget(), TIMED))
    assert trial.variant.policy == "uniform"
    assert trial.budget.equal is BudgetMode.ITERATIONS
    assert [budget.rate_hz for budget in study(TrialBudget(), told, TIMED).paced(5.0).budgets] == [None, 7.0, 5.0]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"trial": "another", "rate_hz": 5}', '{"trial": 1}'])
def test_a_rate_of_something_else_is_not_taken(tmp_path: Path, content: str) -> None:
    path = tmp_path / "rate.json"
    path.write_text(content)
    assert kept_rate(path, pacing_trials(study(TIMED))) is None


def test_a_kept_rate_that_is_none_is_refused(tmp_path: Path) -> None:
    path, trials = tmp_path / "rate.json", pacing_trials(study(TIMED))
    path.write_text(json.dumps({"trial": trials[0].key, "rate_hz": -1.0}))
    with pytest.raises(InvalidInputError, match=r"rate: expected 0\.01 to 1000 Hz, got -1"):
        kept_rate(path, trials)


def test_everyone_has_the_time_of_uniform_mapping_and_a_run_that_goes_on_keeps_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    asked = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "4", "--views", "2", "--policies", "task"]
    command = ["bench", "quality", "--out", str(tmp_path), *asked, "--max-gaussians", "1500", "--threads", "1"]
    assert main([*command, "--equal", "time"]) == 0
    assert "as uniform mapping takes for 8 iterations a frame" in capsys.readouterr().err
    rate_hz = json.loads((tmp_path / "rate.json").read_text())["rate_hz"]
    report = json.loads((tmp_path / "quality.json").read_text())
    assert [(each["equal"], each["rate_hz"]) for each in report["budgets"]] == [("time", rate_hz)]
    assert (
        f"## Equal time ({1e3 / rate_hz:.3g} ms a frame), at most 1500 Gaussians"
        in (tmp_path / "quality.md").read_text()
    )
    assert main([*command, "--equal", "time"]) == 0
    assert "(kept)" in capsys.readouterr().err
