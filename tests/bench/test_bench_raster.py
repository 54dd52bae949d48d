"""Measurements and output of the rasterizer's benchmark on tiny cases; times are not asserted."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from gausslite.cli.main import main
from gausslite_bench.cli.argument_types import read_percentages
from gausslite_bench.raster.block_cost import BlockCost
from gausslite_bench.raster.motion_costs import MOTIONS
from gausslite_bench.raster.operation_costs import RasterBench
from gausslite_bench.raster.procedural_room import held_out_view, seed_rows
from gausslite_bench.raster.region_costs import Layout, regions_of_share
from gausslite_bench.raster.repeated_step import LOSSES

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

from gausslite.render.cpu import CpuRasterizer, usable_simd

KEYS = [
    "gaussians",
    "width",
    "height",
    "threads",
    "simd",
    "fused_l1_ms_min",
    "fused_l1_ssim_ms_min",
    "forward_ms_min",
    "backward_ms_min",
]


def test_seed_rows_render_the_held_out_view() -> None:
    view = held_out_view(96, 72)
    rendering = CpuRasterizer(threads=1).forward(seed_rows(30_000), view.camera, view.T_camera_world)
    seen = rendering.alpha > 0.9
    assert seen.mean() > 0.7
    assert np.median(np.abs(rendering.expected_depth_m() - view.depth_m)[seen]) < 0.03
    assert np.median(np.abs(rendering.rgb - view.rgb / 255.0)[seen]) < 0.08


def test_every_case_is_measured_on_every_instruction_set() -> None:
    bench = RasterBench([(48, 32), (32, 32)], [50], simd=usable_simd(), threads=1, repetitions=1)
    timings = list(bench.run())
    assert [(t.width, t.simd) for t in timings] == [(width, simd) for width in (48, 32) for simd in usable_simd()]
    for timing in timings:
        assert timing.external == {}
        assert timing.regions == ()
        assert {(cost.motion, cost.loss) for cost in timing.motions} == set(itertools.product(MOTIONS, LOSSES))
        assert all(cost.moving.min_ms > 0 and cost.still.min_ms > 0 for cost in timing.motions)
        assert set(timing.stages_ms) == {"fused_l1", "fused_l1_ssim"}
        assert all(0 < duration.min_ms <= duration.median_ms for duration in timing.durations.values())


def test_json_is_a_list_of_flat_records(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--sizes", "32x32", "--gaussians", "20,40", "--threads", "1", "--simd", "portable", "--reps", "2"]
    assert main(["bench", "raster", *small, "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert [record["gaussians"] for record in records] == [20, 40]
    assert [list(record) for record in records] == [KEYS, KEYS]
    assert {(record["simd"], record["threads"], record["width"]) for record in records} == {("portable", 1, 32)}


def test_details_contain_every_number_of_every_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "details.json"
    small = ["--sizes", "48x32", "--gaussians", "20,40", "--threads", "1", "--reps", "1", "--shares", "10,100"]
    assert main(["bench", "raster", *small, "--details", str(file)]) == 0
    assert "10 % compact   fused_l1 " in capsys.readouterr().out
    cases = json.loads(file.read_text())["cases"]
    assert [case["gaussians"] for case in cases] == [20, 40]
    for case in cases:
        assert set(case["operations"]) == {"fused_l1", "fused_l1_ssim", "forward", "backward"}
        assert case["blocks"]["evaluations"] > 0
        assert [(each["motion"], each["loss"]) for each in case["motions"]] == [
            (motion, loss) for loss in LOSSES for motion in MOTIONS
        ]
        regions = [(each["share_percent"], each["layout"], each["loss"]) for each in case["regions"]]
        assert len(set(regions)) == 2 * 3 * 2
        assert all(each["ratio"] > 0 for each in case["regions"])
        whole = [each["work_share"] for each in case["regions"] if each["share_percent"] == 100]
        assert whole == [1.0] * 6


def test_cycles_are_summed_over_threads_in_the_stage_that_evaluates_blocks() -> None:
    stages = {"project": 5.0, "raster": 2.0, "loss": 7.0, "backward": 1.0, "update": 9.0}
    cost = BlockCost.of(evaluations=300_000, clock_ghz=3.4, threads=2, stages_ms=stages)
    assert cost.cycles == pytest.approx(2 * 2.0e-3 * 3.4e9 / 300_000)


@pytest.mark.parametrize("layout", [Layout.COMPACT, Layout.SCATTERED])
def test_a_smaller_share_of_tiles_lies_inside_a_larger_one(layout: Layout) -> None:
    shares = [regions_of_share((240, 320), percent, layout)[0] for percent in (0.1, 5, 20, 50, 100)]
    assert [int(tiles.sum()) for tiles in shares] == [1, 15, 60, 150, 300]
    for smaller, larger in itertools.pairwise(shares):
        assert not (smaller & ~larger).any()


@pytest.mark.parametrize(("percent", "count"), [(100, 1), (50, 2), (20, 5), (5, 20)])
def test_bands_cover_the_image_once(percent: float, count: int) -> None:
    bands = regions_of_share((240, 330), percent, Layout.BANDS)
    assert len(bands) == count
    assert np.sum(bands, axis=0).tolist() == np.ones((15, 21), int).tolist()
    assert {int(band.sum()) for band in bands} <= {315 // count, -(-315 // count)}
    assert max(int(np.ptp(np.nonzero(band)[1])) for band in bands) <= 21 // count + 1


def test_zero_percent_disables_shares() -> None:
    assert read_percentages("0") == ()
    assert read_percentages("5,20.5") == (5.0, 20.5)


def test_a_file_other_than_a_library_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = tmp_path / "other.so"
    library.write_text("not a library")
    small = ["--sizes", "32x32", "--gaussians", "20", "--threads", "1", "--reps", "1"]
    assert main(["bench", "raster", *small, "--external-rasterizer", str(library)]) == 2
    captured = capsys.readouterr().err
    assert "other.so: expected a shared library with gl_new" in captured
    assert captured.count("\n") == 1
