"""The trial cache: results of the running code."""

from dataclasses import replace
from pathlib import Path

import pytest
from quality_results import TASK, finished

from gausslite_bench.quality.trial_cache import TrialCache
from gausslite_bench.quality.trials import TrialBudget


def test_a_stored_trial_is_loaded_unless_lpips_is_requested_and_missing(tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    assert cache.load(one.trial, with_lpips=False) is None
    cache.store(one.trial, one.result)
    assert cache.load(one.trial, with_lpips=False) == one.result
    assert cache.load(one.trial, with_lpips=True) is None
    assert cache.load(replace(one.trial, seed=1), with_lpips=False) is None


@pytest.mark.parametrize("record", ["{}", "[]", "1", "", '{"result": {}}'])
def test_an_invalid_record_is_not_loaded(record: str, tmp_path: Path) -> None:
    cache, one = TrialCache(tmp_path), finished(TASK, 0, 25.0, TrialBudget())
    cache.store(one.trial, one.result)
    next((tmp_path / "trials").glob("*.json")).write_text(record)
    assert cache.load(one.trial, with_lpips=False) is None


def test_a_result_of_other_code_is_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = finished(TASK, 0, 25.0, TrialBudget())
    TrialCache(tmp_path).store(one.trial, one.result)
    monkeypatch.setattr("gausslite_bench.quality.trial_cache.current_code_hash", lambda: "other")
    assert TrialCache(tmp_path).load(one.trial, with_lpips=False) is None
