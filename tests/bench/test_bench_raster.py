"""Measurements and output of the rasterizers' benchmark on tiny cases; times are not asserted."""

import json

import numpy as np
import pytest

from gausslite.cli.main import main
from gausslite.domain.pose import inverse
from gausslite_bench.raster.operation_costs import operation_times
from gausslite_bench.raster.room import held_out_frame, seed_rows

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

from gausslite.render.cpu import CpuRasterizer, usable_simd

OPERATIONS = {"fused_l1", "fused_l1_ssim", "region", "forward", "forward_backward"}


def test_seed_rows_render_the_held_out_frame() -> None:
    view = held_out_frame(96, 72)
    rendering = CpuRasterizer(threads=1).forward(seed_rows(30_000), view.camera, inverse(view.T_world_camera))
    seen = rendering.alpha > 0.9
    assert seen.mean() > 0.7
    assert np.median(np.abs(rendering.expected_depth_m() - view.depth_m)[seen]) < 0.03
    assert np.median(np.abs(rendering.rgb - view.rgb / 255.0)[seen]) < 0.08


def test_every_case_is_measured_on_every_instruction_set(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--sizes", "48x32,32x32", "--gaussians", "20,40", "--threads", "1", "--simd", "all", "--reps", "2"]
    assert main(["bench", "raster", *small, "--json"]) == 0
    cases = json.loads(capsys.readouterr().out)["cases"]
    expected = [(size, simd, count) for size in ([48, 32], [32, 32]) for simd in usable_simd() for count in (20, 40)]
    assert [(case["size"], case["simd"], case["gaussians"]) for case in cases] == expected
    for case in cases:
        assert set(case["operations"]) == OPERATIONS
        assert all(0 < each["min_ms"] <= each["median_ms"] for each in case["operations"].values())


def test_another_backend_is_measured_alike() -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    from torch_oracle.emulated_kernels import TorchKernels

    from gausslite_gpu.rasterizer import CudaRasterizer

    times = operation_times(CudaRasterizer(TorchKernels()), 60, held_out_frame(48, 32), 1)
    assert set(times) == OPERATIONS


def test_without_a_gpu_the_command_fails_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    assert main(["bench", "gpu"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
