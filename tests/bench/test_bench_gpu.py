"""Measurements and output of the GPU benchmark on tiny cases with torch kernels; times are not asserted."""

from __future__ import annotations

import inspect
import json
from typing import Any

import pytest

from gausslite.cli.main import main
from gausslite.render.rasterizer import LossWeights
from gausslite_bench.cli.gpu import frame_lines, gpu_record, rate_heading, rate_line
from gausslite_bench.raster.gpu_rates import GpuBench
from gausslite_bench.raster.procedural_room import held_out_view, seed_rows
from gausslite_bench.raster.repeated_step import ZERO_LEARNING_RATES

pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("gsplat", reason="gsplat is not installed; pip install gausslite[cuda]")

import gsplat
import torch
from torch_oracle.emulated_kernels import TorchKernels

from gausslite_bench.raster.gsplat_baseline import GsplatBaseline
from gausslite_gpu.kernels import project
from gausslite_gpu.rasterizer import CudaRasterizer
from gausslite_gpu.tables import DeviceCamera

torch.set_num_threads(1)
SIZE = (48, 32)


def rasterization(*args: Any, **options: Any) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Replace gsplat.rasterization, with its signature, by torch operations: one view, all splats in front of it."""
    given = inspect.signature(gsplat.rasterization).bind(*args, **options).arguments
    quats, logits = given["quats"], given["opacities"].logit()[:, None]
    columns = [
        given["means"],
        given["scales"].log(),
        quats,
        logits,
        given["colors"],
        torch.zeros_like(quats[:, :2]),
    ]
    kernels, size = TorchKernels(), (given["width"], given["height"])
    camera = DeviceCamera.of(held_out_view(*size).camera, kernels.device)
    rows = torch.cat(columns, dim=1)
    channels, alpha = kernels.composite(project(kernels, rows, camera, given["viewmats"][0]), size, None)
    return channels[None], alpha[None, ..., None], {}


@pytest.fixture(scope="module")
def bench() -> GpuBench:
    return GpuBench(
        CudaRasterizer(TorchKernels()),
        gaussians=(60, 90),
        frame_gaussians=80,
        size=SIZE,
        repetitions=1,
        frames=1,
        rasterization=rasterization,
    )


def test_every_size_of_map_is_measured_and_a_whole_frame(bench: GpuBench) -> None:
    rates, frame = list(bench.rates()), bench.frame()
    assert [rate.gaussians for rate in rates] == [60, 90]
    for rate in rates:
        assert set(rate.best) == set(rate.median) == {"whole", "region", "gsplat"}
        assert all(rate.best[name] >= rate.median[name] > 0 for name in rate.best)
        assert str(rate.gaussians) in rate_line(rate)
    assert frame.iterations == 8
    assert {"seeding", "warm_up", "active", "pruning", "densification"} <= set(frame.stages_ms)
    record = json.loads(json.dumps(gpu_record("a device", rates, frame)))
    assert [case["gaussians"] for case in record["rates"]] == [60, 90]
    assert "the paper's frame time is 500 ms" in frame_lines(frame)
    assert "48x32" in rate_heading("a device", bench)


def test_the_gsplat_baseline_has_the_loss_of_our_step() -> None:
    rasterizer, view, loss = CudaRasterizer(TorchKernels()), held_out_view(*SIZE), LossWeights()
    prepared = rasterizer.prepare_view(view.rgb, view.depth_m, view.camera)
    rows = seed_rows(60)
    step = rasterizer.step(rows, rows * 0, rows * 0, prepared, view.T_camera_world, loss, ZERO_LEARNING_RATES)
    plain = GsplatBaseline(rows[step.visible], prepared, view.T_camera_world, loss, rasterization)
    assert plain.train(2) == pytest.approx(step.loss, rel=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_without_a_gpu_the_command_fails_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "gpu"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "expected a CUDA device" in captured.err
