"""Memory trend of a long run, and the order of its frames."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.loop.memory import MemoryTrend, back_and_forth


def test_back_and_forth_is_continuous_at_both_ends() -> None:
    assert back_and_forth(4, 10) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert back_and_forth(1, 3) == [0, 0, 0]
    positions = back_and_forth(7, 100)
    assert set(np.abs(np.diff(positions))) == {1}
    assert set(positions) == set(range(7))


def test_the_slope_is_fitted_to_the_second_half() -> None:
    trend = MemoryTrend.of([100.0, 300.0, 400.0, 410.0, 420.0, 430.0], sample_interval_frames=50)
    assert (trend.start_mib, trend.middle_mib, trend.end_mib) == (100.0, 410.0, 430.0)
    assert trend.mib_per_1000_frames == pytest.approx(200.0)
    assert MemoryTrend.of([7.0, 7.0], 1).mib_per_1000_frames == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(InvalidInputError, match="at least 2"):
        MemoryTrend.of([7.0], 1)


def test_a_looped_run_reports_its_memory_and_the_gap_to_unlimited_time(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    small = (
        "--frames",
        "0:16",
        "--size",
        "96x72",
        "--max-gaussians",
        "1500",
        "--set",
        "threads=1",
        "--iterations",
        "4",
    )
    options = ("--objects", "table", "--loop", "18", "--unlimited", "6", "--json")
    assert main(["bench", "loop", "sim:home?seed=0&trajectory=0", *small, *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 18
    assert report["memory"]["start_mib"] > 0
    gap = report["rate_gap"]
    assert gap["iterations"] == 6
    assert gap["gap_db"] == pytest.approx(gap["unlimited_db"] - gap["in_time_db"], abs=1e-5)
    for iterations in ("overhead", "overhead_full_image", "overhead_region"):
        assert 0.0 < report[f"{iterations}_percent"] < 100.0
