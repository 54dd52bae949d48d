"""`gausslite bench`: benchmarks of speed and map quality on this machine."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite_bench.chaos.run import ChaosSettings, run_chaos
from gausslite_bench.cli.loop import configure_loop
from gausslite_bench.cli.parser import configure_parser
from gausslite_bench.cli.perception import configure_perception
from gausslite_bench.cli.quality import configure_ablation, configure_compute, configure_quality
from gausslite_bench.cli.team import configure_team
from gausslite_bench.fuzz.run import FuzzSettings, run_fuzz
from gausslite_bench.kidnaps import KidnapSettings, run_kidnaps
from gausslite_bench.raster.operation_costs import GpuSettings, RasterSettings, run_gpu, run_raster
from gausslite_bench.report import Report
from gausslite_bench.server.bench import ServerBenchSettings, run_server
from gausslite_bench.team.frame_attacks import FrameAttackSettings, run_frame_attacks
from gausslite_bench.tour import TourSettings, run_tour


@dataclass(frozen=True, slots=True)
class _Measurement:
    """A benchmark of a settings class, whose fields are its flags; the command prints the report."""

    settings: type
    measure: Callable[[Any], Report]

    def __call__(self, parser: CommandParser) -> None:
        """Add the options to a parser."""
        add_flags(parser, self.settings)
        parser.add_argument("--json", action="store_true", help="print JSON for scripts")
        parser.set_defaults(run=self._run)

    def _run(self, options: argparse.Namespace) -> int:
        report = self.measure(build(self.settings, options))
        print(report.text(options.json))
        return 0 if report.is_good else 1


_BENCHMARKS: dict[str, tuple[Callable[[CommandParser], None], str]] = {
    "quality": (configure_quality, "map quality of every policy on held-out views, at an equal budget"),
    "ablation": (configure_ablation, "map quality with the paper's components enabled one by one"),
    "compute": (configure_compute, "map quality as one quantity grows: iterations, time, frames or Gaussians"),
    "team": (configure_team, "quality of the fused map of several agents, by strategy and policy"),
    "perception": (configure_perception, "accuracy of a detector's masks against ground truth, stage by stage"),
    "parser": (configure_parser, "accuracy and speed of a task parser on known sentences"),
    "loop": (configure_loop, "frame rate, time of each stage and memory of one agent's mapping loop"),
    "raster": (_Measurement(RasterSettings, run_raster), "time of the CPU rasterizer's operations on a room"),
    "gpu": (_Measurement(GpuSettings, run_gpu), "time of the CUDA backend's operations on a room"),
    "server": (
        _Measurement(ServerBenchSettings, run_server),
        "largest team, memory and times of a fusion server by the size of its map, and under attacks",
    ),
    "chaos": (
        _Measurement(ChaosSettings, run_chaos),
        "a fusion server and its agents under kills, partitions and a full disk",
    ),
    "frames": (
        _Measurement(FrameAttackSettings, run_frame_attacks),
        "whom robots in wrong frames harm in a team",
    ),
    "kidnaps": (
        _Measurement(KidnapSettings, run_kidnaps),
        "a robot that is carried, covered or restarted in a recording",
    ),
    "tour": (
        _Measurement(TourSettings, run_tour),
        "a tour through many homes and back: memory, disk, and what is left of the first one",
    ),
    "fuzz": (_Measurement(FuzzSettings, run_fuzz), "mutated messages for the codec and every method of the services"),
}


def configure(parser: CommandParser) -> None:
    """Add the benchmarks and their options."""
    benchmarks = parser.add_subparsers(dest="bench", required=True, metavar="BENCHMARK")
    for name, (configure_benchmark, summary) in _BENCHMARKS.items():
        description = f"{summary[0].upper()}{summary[1:]}."
        configure_benchmark(benchmarks.add_parser(name, help=summary, description=description))
