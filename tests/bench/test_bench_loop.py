"""Counts and output of the loop benchmark on a few small frames; times are not asserted."""

import json

import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import DatasetError
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite.mission.task_mapper import FrameOutcome
from gausslite_bench.frame_costs import loop_figures

SMALL = ("--size", "96x72", "--max-gaussians", "1500", "--set", "threads=1")


def outcome(perception_s: float, iterations: int) -> FrameOutcome:
    stages_s = {Stage.RELEVANCE: perception_s, Stage.SEEDING: 0.03, Stage.PUBLISHING: 0.01}
    timing = FrameTiming(
        sum(stages_s.values()), stages_s, frozenset({SkippableStage.SEEDING}), under_trained=iterations < 5
    )
    return FrameOutcome(index=0, iterations=iterations, gaussians=100 * iterations, roi_share=0.5, timing=timing)


def test_hz_is_frames_by_the_sum_of_their_latencies() -> None:
    figures = loop_figures([outcome(0.06, 4), outcome(0.26, 8)])
    assert figures["hz"] == pytest.approx(2 / 0.4)
    assert (figures["iterations_mean"], figures["iterations_min"], figures["gaussians"]) == (6.0, 4, 800)
    assert figures["latency"]["max_ms"] == pytest.approx(300.0)


def test_stages_skips_and_under_trained_frames_are_counted() -> None:
    figures = loop_figures([outcome(0.06, 4), outcome(0.26, 8)])
    assert figures["stages"]["seeding"]["p50_ms"] == pytest.approx(30.0)
    assert figures["stages"]["rendering"]["max_ms"] == 0.0
    assert figures["skipped_stages"] == {"publishing": 0, "seeding": 2}
    assert figures["frames_under_trained"] == 1


def test_no_mapped_frame_is_an_error() -> None:
    pytest.raises(DatasetError, loop_figures, []).match("at least one frame with depth")


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
    for times in (report["latency"], report["stages"]["relevance"], report["stages"]["publishing"]):
        assert 0 < times["p50_ms"] <= times["p90_ms"] <= times["p99_ms"] <= times["max_ms"]
    if budget[0] == "--iterations":
        assert (report["iterations_mean"], report["iterations_min"]) == (2.0, 2)
