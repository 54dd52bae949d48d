"""Counts and output of the loop benchmark on a few small frames; times are not asserted."""

from __future__ import annotations

import json

import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import DatasetError
from gausslite.mapping.training import SkippableStage, Stage
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite_bench.loop.frame_costs import CostLog, FrameCost, LoopTiming

SMALL = ("--size", "96x72", "--max-gaussians", "1500", "--set", "threads=1")


def cost(perception_s: float, iterations: int) -> FrameCost:
    stages_s = {Stage.RELEVANCE: perception_s, Stage.SEEDING: 0.03, Stage.PUBLISHING: 0.01}
    budget = FrameTiming(
        sum(stages_s.values()), stages_s, frozenset({SkippableStage.SEEDING}), under_trained=iterations < 5
    )
    return FrameCost(budget, iterations, gaussians=100 * iterations, roi_share=0.5)


def test_hz_is_frames_by_the_sum_of_their_latencies() -> None:
    timing = LoopTiming.of([cost(0.06, 4), cost(0.26, 8)])
    assert timing.hz == pytest.approx(2 / 0.4)
    assert (timing.iterations_mean, timing.iterations_min, timing.gaussians) == (6.0, 4, 800)
    assert timing.latency.max_ms == pytest.approx(300.0)
    assert timing.mapping.max_ms == pytest.approx(30.0)


def test_stages_skips_and_under_trained_frames_are_counted() -> None:
    timing = LoopTiming.of([cost(0.06, 4), cost(0.26, 8)])
    assert timing.stages["seeding"].p50_ms == pytest.approx(30.0)
    assert timing.stages["rendering"].max_ms == 0.0
    assert timing.skipped_stages == {"publishing": 0, "seeding": 2}
    assert timing.frames_under_trained == 1


def test_the_log_returns_the_costs_that_were_appended() -> None:
    log, costs = CostLog(), [cost(0.06, 4), cost(0.26, 8), cost(0.1, 0)]
    for each in costs:
        log.append(each)
    assert log.costs() == costs
    assert CostLog().costs() == []


def test_no_mapped_frame_is_an_error() -> None:
    with pytest.raises(DatasetError, match="at least one frame with depth"):
        LoopTiming.of([])


@pytest.mark.parametrize("budget", [("--iterations", "2"), ("--rate", "200")])
def test_the_home_is_mapped_and_the_figures_are_json(
    budget: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
    assert main(["bench", "loop", "--frames", "0:4", *SMALL, *budget, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["task"] == "Pick up the mug on the table"
    assert (report["frames"], report["frames_skipped"], report["size"]) == (4, 0, [96, 72])
    assert 0 < report["gaussians"] <= 1500
    assert report["hz"] > 0
    assert report["peak_rss_mib"] > 0
    for part in ("latency", "perception", "mapping", "publishing"):
        times = report[part]
        assert 0 < times["p50_ms"] <= times["p90_ms"] <= times["p99_ms"] <= times["max_ms"]
    if budget[0] == "--iterations":
        assert (report["iterations_mean"], report["iterations_min"]) == (2.0, 2)
