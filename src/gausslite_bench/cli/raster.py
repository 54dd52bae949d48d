"""`gausslite bench raster`: times of the CPU rasterizer's operations."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

from gausslite.mission.results import prepare_file, write_json
from gausslite_bench.cli.argument_types import read_counts, read_image_sizes, read_percentages
from gausslite_bench.raster.block_cost import BlockCost
from gausslite_bench.raster.motion_costs import MotionCost
from gausslite_bench.raster.operation_costs import GAUSSIANS, OPERATIONS, SIZES, RasterBench, RasterTiming
from gausslite_bench.raster.region_costs import SHARES_PERCENT, RegionCost


def configure_raster(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench raster`."""
    add = parser.add_argument
    add(
        "--sizes",
        metavar="WxH,...",
        type=read_image_sizes,
        default=SIZES,
        help="image sizes (default: 320x240,640x480)",
    )
    counts = ",".join(str(count) for count in GAUSSIANS)
    add(
        "--gaussians",
        metavar="N,...",
        type=read_counts,
        default=GAUSSIANS,
        help=f"numbers of Gaussians (default: {counts})",
    )
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    add("--simd", metavar="NAME", help="instruction set, or all (default: the fastest supported one)")
    add("--reps", metavar="N", type=int, default=60, help="timed runs of each operation (default: %(default)s)")
    add(
        "--external-rasterizer",
        metavar="LIB.so",
        type=Path,
        help="also measure this rasterizer library, interleaved with GaussLite's (bench/results)",
    )
    shares = ",".join(f"{share:g}" for share in SHARES_PERCENT)
    add(
        "--shares",
        metavar="P,...",
        type=read_percentages,
        default=SHARES_PERCENT,
        help=f"percentages of the image for steps masked to a region, or 0 for none (default: {shares})",
    )
    parser.add_argument(
        "--json", action="store_true", help="print JSON: the minimum time of each operation, without --shares"
    )
    add("--details", metavar="FILE", type=Path, help="write all measurements to this JSON file")
    parser.set_defaults(run=run_raster)


def run_raster(options: argparse.Namespace) -> int:
    """Measure every case; print lines of text for each, or one JSON list."""
    from gausslite.render.cpu import usable_simd

    if options.details is not None:
        prepare_file(options.details)
    bench = RasterBench(
        sizes=options.sizes,
        gaussians=options.gaussians,
        simd=usable_simd() if options.simd == "all" else (options.simd,),
        threads=options.threads,
        repetitions=options.reps,
        external_library=options.external_rasterizer,
        shares_percent=() if options.json and options.details is None else options.shares,
    )
    timings = []
    for timing in bench.run():
        timings.append(timing)
        if not options.json:
            print(raster_lines(timing), flush=True)
    if options.json:
        print(json.dumps([timing.summary() for timing in timings], indent=2))
    if options.details is not None:
        cases = [timing.details() for timing in timings]
        write_json(options.details, {"command": shlex.join(sys.argv), "cases": cases})
    return 0


def raster_lines(timing: RasterTiming) -> str:
    """Return the case, each operation's minimum and median, and the stages of the fused steps as text."""
    lines = [
        f"{timing.gaussians} Gaussians, {timing.width}x{timing.height}, {timing.simd}, {timing.threads} threads "
        "(ms, minimum / median)"
    ]
    for name in OPERATIONS:
        own = timing.durations[name]
        line = f"  {name:<14} {own.min_ms:8.2f} / {own.median_ms:8.2f}"
        if name in timing.external:
            other = timing.external[name]
            ratio = own.min_ms / other.min_ms
            line += f"   external {other.min_ms:8.2f} / {other.median_ms:8.2f}   ratio {ratio:.2f}"
        lines.append(line)
        if stages := timing.stages_ms.get(name):
            lines.append("    " + "  ".join(f"{stage} {ms:.2f}" for stage, ms in stages.items()))
    lines.append(f"  {_block_line(timing.blocks)}")
    lines += [_motion_line(cost) for cost in timing.motions]
    lines += [_region_line(cost) for cost in timing.regions]
    return "\n".join(lines)


def _block_line(cost: BlockCost) -> str:
    return (
        f"{cost.evaluations} block evaluations at {cost.clock_ghz:.2f} GHz: {cost.cycles:.1f} cycles each in fused_l1"
    )


def _motion_line(cost: MotionCost) -> str:
    return (
        f"  {cost.motion:<12} {cost.loss:<13} {cost.moving.min_ms:8.2f} / {cost.moving.median_ms:8.2f}   "
        f"at rest {cost.still.min_ms:8.2f} / {cost.still.median_ms:8.2f}   {cost.ratio:.3f} times"
    )


def _region_line(cost: RegionCost) -> str:
    return (
        f"  {cost.share_percent:5g} % {cost.layout:<9} {cost.loss:<13} {cost.region.min_ms:8.2f} / "
        f"{cost.region.median_ms:8.2f}   full {cost.full.min_ms:8.2f} / {cost.full.median_ms:8.2f}   "
        f"{cost.ratio:.3f} times as long, work share {cost.work_share:.3f}"
    )
