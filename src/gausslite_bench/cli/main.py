"""`gausslite bench`: benchmarks of speed and map quality on this machine."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite_bench.chaos.run import ChaosSettings, run_chaos
from gausslite_bench.cli.loop import add_loop_options, run_loop
from gausslite_bench.cli.parser import add_parser_options, run_parser
from gausslite_bench.cli.perception import add_perception_options, run_perception
from gausslite_bench.cli.quality import configure_ablation, configure_compute, configure_quality
from gausslite_bench.cli.team import configure_team
from gausslite_bench.fuzz.run import FuzzSettings, run_fuzz
from gausslite_bench.kidnap_events import KidnapSettings
from gausslite_bench.kidnaps import run_kidnaps
from gausslite_bench.raster.operation_costs import GpuSettings, RasterSettings, run_gpu, run_raster
from gausslite_bench.report import Report
from gausslite_bench.server.bench import ServerBenchSettings, run_server
from gausslite_bench.team.frame_attacks import FrameAttackSettings, run_frame_attacks
from gausslite_bench.tour import TourSettings, run_tour


def _measured(
    add_options: Callable[[CommandParser], object], measure: Callable[[argparse.Namespace], Report]
) -> Callable[[CommandParser], None]:
    """Return what configures a benchmark whose command prints a report, which may be bad: code 1."""

    def run(options: argparse.Namespace) -> int:
        report = measure(options)
        print(report.text(options.json))
        return 0 if report.is_good else 1

    def configure_benchmark(parser: CommandParser) -> None:
        add_options(parser)
        parser.add_argument("--json", action="store_true", help="print JSON for scripts")
        parser.set_defaults(run=run)

    return configure_benchmark


def _of_settings(settings: type, measure: Callable[[Any], Report]) -> Callable[[CommandParser], None]:
    """Return what configures a benchmark whose flags are the fields of a settings class."""
    return _measured(lambda parser: add_flags(parser, settings), lambda options: measure(build(settings, options)))


_BENCHMARKS: dict[str, tuple[Callable[[CommandParser], None], str]] = {
    "quality": (configure_quality, "map quality of every policy on held-out views, at an equal budget"),
    "ablation": (configure_ablation, "map quality with the paper's components enabled one by one"),
    "compute": (configure_compute, "map quality as one quantity grows: iterations, time, frames or Gaussians"),
    "team": (configure_team, "quality of the fused map of several agents, by strategy and policy"),
    "perception": (
        _measured(add_perception_options, run_perception),
        "accuracy of a detector's masks against ground truth, stage by stage",
    ),
    "parser": (_measured(add_parser_options, run_parser), "accuracy and speed of a task parser on known sentences"),
    "loop": (
        _measured(add_loop_options, run_loop),
        "frame rate, time of each stage and memory of one agent's mapping loop",
    ),
    "raster": (_of_settings(RasterSettings, run_raster), "time of the CPU rasterizer's operations on a room"),
    "gpu": (_of_settings(GpuSettings, run_gpu), "time of the CUDA backend's operations on a room"),
    "server": (
        _of_settings(ServerBenchSettings, run_server),
        "largest team, memory and times of a fusion server by the size of its map, and under attacks",
    ),
    "chaos": (
        _of_settings(ChaosSettings, run_chaos),
        "a fusion server and its agents under kills, partitions and a full disk",
    ),
    "frames": (
        _of_settings(FrameAttackSettings, run_frame_attacks),
        "whom robots in wrong frames harm in a team",
    ),
    "kidnaps": (
        _of_settings(KidnapSettings, run_kidnaps),
        "a robot that is carried, covered or restarted in a recording",
    ),
    "tour": (
        _of_settings(TourSettings, run_tour),
        "a tour through many homes and back: memory, disk, and what is left of the first one",
    ),
    "fuzz": (_of_settings(FuzzSettings, run_fuzz), "mutated messages for the codec and every method of the services"),
}


def configure(parser: CommandParser) -> None:
    """Add the benchmarks and their options."""
    benchmarks = parser.add_subparsers(dest="bench", required=True, metavar="BENCHMARK")
    for name, (configure_benchmark, summary) in _BENCHMARKS.items():
        description = f"{summary[0].upper()}{summary[1:]}."
        configure_benchmark(benchmarks.add_parser(name, help=summary, description=description))
