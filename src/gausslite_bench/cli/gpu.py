"""`gausslite bench gpu`: its options, and its figures as a table."""

from __future__ import annotations

import argparse
import json

from gausslite.errors import KernelError
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.raster.gpu_rates import PAPERS_FRAME_MS, FrameCost, GpuBench, StepRate


def run_gpu(options: argparse.Namespace) -> int:
    """Measure, and print a table or one JSON object. Raises KernelError without a GPU that can be used."""
    rasterizer = choose_rasterizer("cuda")
    from gausslite.render.cuda import CudaRasterizer

    if not isinstance(rasterizer, CudaRasterizer):
        raise KernelError(f"bench gpu: expected the cuda backend, got {rasterizer.name}")
    bench = GpuBench(rasterizer, gaussians=options.gaussians, repetitions=options.reps)
    if options.json:
        print(json.dumps(gpu_record(rasterizer.device_name, list(bench.rates()), bench.frame()), indent=2))
        return 0
    print(rate_heading(rasterizer.device_name, bench), flush=True)
    for rate in bench.rates():
        print(rate_line(rate), flush=True)
    print(frame_lines(bench.frame()))
    return 0


def gpu_record(device: str, rates: list[StepRate], frame: FrameCost) -> dict[str, object]:
    """Everything that was measured, for scripts."""
    return {"device": device, "rates": [rate.as_json() for rate in rates], "frame": frame.as_json()}


def rate_heading(device: str, bench: GpuBench) -> str:
    """What the lines of the table say."""
    width, height = bench.size
    names = "".join(f"{name:>20}" for name in ("whole image", "a fifth of it", "gsplat plainly"))
    return f"{device}, {width}x{height}, iterations a second (best / median of turns)\n{'Gaussians':>10}{names}  ratio"


def rate_line(rate: StepRate) -> str:
    """One size of map. The ratio is ours over gsplat's, on the whole image."""
    cells = (f"{rate.best[name]:.1f} / {rate.median[name]:.1f}" for name in ("whole", "region", "gsplat"))
    ratio = rate.best["whole"] / rate.best["gsplat"]
    return f"{rate.gaussians:>10}" + "".join(f"{cell:>20}" for cell in cells) + f"  {ratio:.2f}"


def frame_lines(cost: FrameCost) -> str:
    """The frame, and where its time went."""
    steps = "  ".join(f"{name} {ms:.1f}" for name, ms in cost.steps_ms.items())
    return (
        f"a frame on {cost.gaussians} Gaussians, {cost.iterations} iterations: {cost.whole.min_ms:.1f} / "
        f"{cost.whole.median_ms:.1f} ms (minimum / median; the paper allows {PAPERS_FRAME_MS:.0f})\n  {steps}"
    )
