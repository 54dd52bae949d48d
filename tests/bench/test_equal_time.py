"""At equal time the rate of uniform mapping is measured once per study, unless a rate is given."""

import json
from pathlib import Path

import pytest
from quality_results import CONDITIONS, PLAN, TASK, UNIFORM, finished

from gausslite.cli.main import main
from gausslite_bench.quality.study import Study, with_measured_rate
from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_bench.quality.trials import BudgetMode, TrialBudget


def test_the_rate_is_that_of_uniform_mapping_with_the_iterations(tmp_path: Path) -> None:
    cache, measured = TrialCache(tmp_path), finished(UNIFORM, 0, 25.0, TrialBudget(iterations=3))
    cache.store(measured.trial, measured.result)
    given = TrialBudget(equal=BudgetMode.TIME, rate_hz=7.0)
    timed = TrialBudget(equal=BudgetMode.TIME, iterations=3)
    study = Study([PLAN], [TASK], [TrialBudget(), given, timed], [0], CONDITIONS)
    assert [budget.rate_hz for budget in with_measured_rate(study, cache).budgets] == [None, 7.0, 80.0]


@pytest.mark.slow
def test_the_rate_is_measured_and_reused_on_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    options = ["--pairs", "home-8-manipulation", "--size", "96x72", "--frames", "4", "--views", "2"]
    options += ["--policies", "task"]
    command = ["bench", "quality", "--out", str(tmp_path), *options, "--max-gaussians", "1500", "--threads", "1"]
    assert main([*command, "--equal", "time"]) == 0
    assert "equal time" in capsys.readouterr().err
    report = json.loads((tmp_path / "quality.json").read_text())
    [rate_hz] = {each["budget"]["rate_hz"] for each in report["trials"]}
    assert (
        f"## Equal time ({1e3 / rate_hz:.3g} ms per frame), at most 1500 Gaussians"
        in (tmp_path / "quality.md").read_text()
    )
    assert main([*command, "--equal", "time"]) == 0
    assert "(cached)" in capsys.readouterr().err
    assert json.loads((tmp_path / "quality.json").read_text())["trials"] == report["trials"]
