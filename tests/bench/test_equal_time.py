"""At equal time the rate of uniform mapping is measured once per study, unless a rate is given."""

import json
from pathlib import Path

import pytest
from quality_results import CONDITIONS, PLAN, TASK

from gausslite.cli.main import main
from gausslite_bench.quality.equal_time import stored_rate, with_measured_rate
from gausslite_bench.quality.study import Study
from gausslite_bench.quality.trials import BudgetMode, TrialBudget

TIMED = TrialBudget(equal=BudgetMode.TIME)


def study(*budgets: TrialBudget) -> Study:
    return Study([PLAN], [TASK], budgets, [0], CONDITIONS)


def test_only_equal_time_without_a_rate_needs_a_measurement(tmp_path: Path) -> None:
    given = TrialBudget(equal=BudgetMode.TIME, rate_hz=7.0)
    assert with_measured_rate(study(TrialBudget(), given), tmp_path) == study(TrialBudget(), given)
    assert [budget.rate_hz for budget in study(TrialBudget(), given, TIMED).with_rate(5.0).budgets] == [None, 7.0, 5.0]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"trial": "another", "rate_hz": 5}', '{"trial": 1}'])
def test_a_rate_of_another_trial_is_not_used(tmp_path: Path, content: str) -> None:
    (tmp_path / "rate.json").write_text(content)
    assert stored_rate(tmp_path, study(TIMED).trials(PLAN)) is None


@pytest.mark.slow
def test_the_rate_of_uniform_mapping_is_measured_and_reused_on_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "4", "--views", "2"]
    options += ["--policies", "task"]
    command = ["bench", "quality", "--out", str(tmp_path), *options, "--max-gaussians", "1500", "--threads", "1"]
    assert main([*command, "--equal", "time"]) == 0
    assert "equal time" in capsys.readouterr().err
    rate_hz = json.loads((tmp_path / "rate.json").read_text())["rate_hz"]
    report = json.loads((tmp_path / "quality.json").read_text())
    assert {each["budget"]["rate_hz"] for each in report["trials"]} == {rate_hz}
    assert (
        f"## Equal time ({1e3 / rate_hz:.3g} ms per frame), at most 1500 Gaussians"
        in (tmp_path / "quality.md").read_text()
    )
    assert main([*command, "--equal", "time"]) == 0
    assert "(cached)" in capsys.readouterr().err
