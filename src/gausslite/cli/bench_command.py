"""`gausslite bench`: how fast this machine draws, trains and maps."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from gausslite.evaluation.bench_raster import GAUSSIANS, OPERATIONS, SIZES, RasterBench, RasterTiming
from gausslite.mission.options import names


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the benchmarks and their options."""
    benches = parser.add_subparsers(dest="bench", required=True, metavar="BENCH")
    summary = "the rasterizer's stages on a small procedural room"
    _configure_raster(benches.add_parser("raster", help=summary, description=f"Measure {summary}."))


def _configure_raster(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--sizes", metavar="WxH,...", type=sizes, default=SIZES, help="image sizes (default: 320x240,640x480)")
    add("--gaussians", metavar="N,...", type=counts, default=GAUSSIANS, help="default: 20000,100000,300000")
    add("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")
    add("--simd", metavar="NAME", help="instruction set, or all (default: the fastest here)")
    add("--reps", metavar="N", type=int, default=60, help="timed runs of each operation (default: %(default)s)")
    add("--yardstick", metavar="LIB.so", type=Path, help="measure this library beside ours, in turns")
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_raster)


def run_raster(options: argparse.Namespace) -> int:
    """Measure every case and print a block of lines for each, or one list of records."""
    from gausslite.render.cpu import usable_simd

    bench = RasterBench(
        sizes=options.sizes,
        gaussians=options.gaussians,
        simd=usable_simd() if options.simd == "all" else (options.simd,),
        threads=options.threads,
        repetitions=options.reps,
        yardstick=options.yardstick,
    )
    if options.json:
        print(json.dumps([timing.as_json() for timing in bench.run()], indent=2))
        return 0
    for timing in bench.run():
        print(as_lines(timing), flush=True)
    return 0


def as_lines(timing: RasterTiming) -> str:
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
    return "\n".join(lines)


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


def _positive(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < len(text) < 10 and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected whole numbers above 0, got {text!r}")
    return int(text)
