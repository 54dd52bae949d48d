"""`gausslite bench gpu`: training speed of the CUDA backend."""

from __future__ import annotations

import argparse
import json

from gausslite.domain.errors import KernelError
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.cli.argument_types import read_counts
from gausslite_bench.raster.gpu_rates import GPU_GAUSSIANS, PAPER_FRAME_MS, GpuBench, GpuFrameCost, StepRate


def configure_gpu(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench gpu`."""
    add = parser.add_argument
    counts = ",".join(str(count) for count in GPU_GAUSSIANS)
    add(
        "--gaussians",
        metavar="N,...",
        type=read_counts,
        default=GPU_GAUSSIANS,
        help=f"numbers of Gaussians (default: {counts})",
    )
    add("--reps", metavar="N", type=int, default=100, help="timed iterations of each kind (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_gpu)


def run_gpu(options: argparse.Namespace) -> int:
    """Run the benchmark and print a table or one JSON object. Raises KernelError without a usable GPU."""
    rasterizer = choose_rasterizer("cuda")
    from gausslite_gpu.rasterizer import CudaRasterizer

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


def gpu_record(device: str, rates: list[StepRate], frame: GpuFrameCost) -> dict[str, object]:
    """Return all measurements as one JSON object."""
    return {"device": device, "rates": [rate.as_json() for rate in rates], "frame": frame.as_json()}


def rate_heading(device: str, bench: GpuBench) -> str:
    """Return the header of the table."""
    width, height = bench.size
    names = "".join(f"{name:>20}" for name in ("full image", "20 % region", "gsplat baseline"))
    return f"{device}, {width}x{height}, iterations per second (best / median)\n{'Gaussians':>10}{names}  ratio"


def rate_line(rate: StepRate) -> str:
    """Return one table row. The ratio is this backend's rate over gsplat's, on the full image."""
    cells = (f"{rate.best[name]:.1f} / {rate.median[name]:.1f}" for name in ("whole", "region", "gsplat"))
    ratio = rate.best["whole"] / rate.best["gsplat"]
    return f"{rate.gaussians:>10}" + "".join(f"{cell:>20}" for cell in cells) + f"  {ratio:.2f}"


def frame_lines(cost: GpuFrameCost) -> str:
    """Return the time of one mapped frame, in total and per stage."""
    stages = "  ".join(f"{name} {ms:.1f}" for name, ms in cost.stages_ms.items())
    return (
        f"one frame on {cost.gaussians} Gaussians, {cost.iterations} iterations: {cost.whole.min_ms:.1f} / "
        f"{cost.whole.median_ms:.1f} ms (minimum / median; the paper's frame time is {PAPER_FRAME_MS:.0f} ms)\n"
        f"  {stages}"
    )
