"""`gausslite bench`: how fast this machine draws, trains and maps, and how good the maps are."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path

from gausslite.config.options import names, numbers
from gausslite.mission.results import prepare_file, write_json
from gausslite_bench.cli import loop as bench_loop_command
from gausslite_bench.cli.gpu import run_gpu
from gausslite_bench.cli.parser import configure_parser
from gausslite_bench.cli.perception import configure_perception
from gausslite_bench.cli.quality import configure_ablation, configure_quality
from gausslite_bench.cli.task_change import configure_task_change
from gausslite_bench.raster.block_cost import BlockCost
from gausslite_bench.raster.gpu_rates import GPU_GAUSSIANS
from gausslite_bench.raster.operation_costs import GAUSSIANS, OPERATIONS, SIZES, RasterBench, RasterTiming
from gausslite_bench.raster.region_costs import SHARES_PERCENT, RegionCost


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the benchmarks and their options."""
    benches = parser.add_subparsers(dest="bench", required=True, metavar="BENCH")
    summary = "the rasterizer's stages on a small procedural room"
    _configure_raster(benches.add_parser("raster", help=summary, description=f"Measure {summary}."))
    summary = "the whole loop of one robot on a sequence"
    bench_loop_command.configure(benches.add_parser("loop", help=summary, description=f"Measure {summary}."))
    summary = "training on a GPU, beside gsplat called plainly"
    _configure_gpu(benches.add_parser("gpu", help=summary, description=f"Measure {summary}."))
    summary = "a task parser's graphs on sentences whose graphs are known"
    configure_parser(benches.add_parser("parser", help=summary, description=f"Score {summary}."))
    summary = "a detector's masks against ground truth, before and after they are placed in space and followed"
    configure_perception(benches.add_parser("perception", help=summary, description=f"Score {summary}."))
    summary = "every policy's maps on held-out views, at the same budget"
    configure_quality(benches.add_parser("quality", help=summary, description=f"Score {summary}."))
    summary = "the paper's components, switched on one by one"
    configure_ablation(benches.add_parser("ablation", help=summary, description=f"Score {summary}."))
    summary = "how soon a map serves a task that came in the middle"
    configure_task_change(benches.add_parser("retask", help=summary, description=f"Measure {summary}."))


def _configure_raster(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--sizes", metavar="WxH,...", type=sizes, default=SIZES, help="image sizes (default: 320x240,640x480)")
    add("--gaussians", metavar="N,...", type=counts, default=GAUSSIANS, help="default: 20000,100000,300000")
    add("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")
    add("--simd", metavar="NAME", help="instruction set, or all (default: the fastest here)")
    add("--reps", metavar="N", type=int, default=60, help="timed runs of each operation (default: %(default)s)")
    add("--yardstick", metavar="LIB.so", type=Path, help="measure this library beside ours, in turns")
    shares = ",".join(f"{share:g}" for share in SHARES_PERCENT)
    add(
        "--shares",
        metavar="P,...",
        type=percentages,
        default=SHARES_PERCENT,
        help=f"percents of the image for the masked step, or 0 for none (default: {shares})",
    )
    add("--json", action="store_true", help="print JSON for scripts: each case's least times, without shares")
    add("--details", metavar="FILE", type=Path, help="write everything that was measured here, as JSON")
    parser.set_defaults(run=run_raster)


def _configure_gpu(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    default = ",".join(str(count) for count in GPU_GAUSSIANS)
    add("--gaussians", metavar="N,...", type=counts, default=GPU_GAUSSIANS, help=f"default: {default}")
    add("--reps", metavar="N", type=int, default=100, help="timed iterations of each kind (default: %(default)s)")
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_gpu)


def run_raster(options: argparse.Namespace) -> int:
    """Measure every case and print a block of lines for each, or one list of records."""
    from gausslite.render.cpu_kernels import usable_simd

    if options.details is not None:
        prepare_file(options.details)
    bench = RasterBench(
        sizes=options.sizes,
        gaussians=options.gaussians,
        simd=usable_simd() if options.simd == "all" else (options.simd,),
        threads=options.threads,
        repetitions=options.reps,
        yardstick=options.yardstick,
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
        write_json(
            options.details, {"command": shlex.join(sys.argv), "cases": [timing.details() for timing in timings]}
        )
    return 0


def raster_lines(timing: RasterTiming) -> str:
    """The case, each operation's minimum and median, and the stages of the fused steps."""
    lines = [
        f"{timing.gaussians} Gaussians, {timing.width}x{timing.height}, {timing.simd}, {timing.threads} threads "
        "(ms, minimum / median)"
    ]
    for name in OPERATIONS:
        ours = timing.durations[name]
        line = f"  {name:<14} {ours.min_ms:8.2f} / {ours.median_ms:8.2f}"
        if name in timing.yardstick:
            other = timing.yardstick[name]
            ratio = ours.min_ms / other.min_ms
            line += f"   yardstick {other.min_ms:8.2f} / {other.median_ms:8.2f}   ratio {ratio:.2f}"
        stages = timing.stages_ms.get(name, {})
        lines.append(line)
        if stages:
            lines.append("    " + "  ".join(f"{stage} {ms:.2f}" for stage, ms in stages.items()))
    lines.append(f"  {_block_line(timing.blocks)}")
    lines += [_region_line(cost) for cost in timing.regions]
    return "\n".join(lines)


def _block_line(cost: BlockCost) -> str:
    return (
        f"{cost.evaluations} block evaluations at {cost.clock_ghz:.2f} GHz: {cost.cycles:.1f} cycles each in fused_l1"
    )


def _region_line(cost: RegionCost) -> str:
    return (
        f"  {cost.share_percent:5g} % {cost.layout:<9} {cost.loss:<13} {cost.region.min_ms:8.2f} / "
        f"{cost.region.median_ms:8.2f}   full {cost.full.min_ms:8.2f} / {cost.full.median_ms:8.2f}   "
        f"ratio {cost.ratio:.3f}, of the work {cost.work_share:.3f}"
    )


def sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Read "WxH,WxH"; argparse reports what is wrong."""
    read = tuple(tuple(_positive(side) for side in part.lower().split("x")) for part in names(text))
    pairs = tuple((size[0], size[1]) for size in read if len(size) == 2)
    if not read or len(pairs) != len(read):
        raise argparse.ArgumentTypeError(f"expected sizes such as 320x240,640x480, got {text!r}")
    return pairs


def counts(text: str) -> tuple[int, ...]:
    """Read "N,N"; argparse reports what is wrong."""
    read = tuple(_positive(part) for part in names(text))
    if not read:
        raise argparse.ArgumentTypeError(f"expected whole numbers such as 20000,100000, got {text!r}")
    return read


def percentages(text: str) -> tuple[float, ...]:
    """Read "5,20"; "0" is none; argparse reports what is wrong."""
    if text.strip() == "0":
        return ()
    read = numbers(text, text.count(",") + 1)
    if not all(0 < share <= 100 for share in read):
        raise argparse.ArgumentTypeError(f"expected percents above 0 and up to 100, or 0 alone, got {text!r}")
    return tuple(read)


def _positive(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < len(text) < 10 and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected whole numbers above 0, got {text!r}")
    return int(text)
