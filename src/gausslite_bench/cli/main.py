"""`gausslite bench`: benchmarks of speed and map quality on this machine."""

from __future__ import annotations

from collections.abc import Callable

from gausslite.config.command_parser import CommandParser
from gausslite_bench.cli.chaos import configure_chaos
from gausslite_bench.cli.fuzz import configure_fuzz
from gausslite_bench.cli.gpu import configure_gpu
from gausslite_bench.cli.loop import configure_loop
from gausslite_bench.cli.parser import configure_parser
from gausslite_bench.cli.perception import configure_perception
from gausslite_bench.cli.places import configure_places
from gausslite_bench.cli.quality import configure_ablation, configure_quality
from gausslite_bench.cli.raster import configure_raster
from gausslite_bench.cli.server import configure_server
from gausslite_bench.cli.team import configure_team
from gausslite_bench.cli.view import configure_view

_BENCHMARKS: dict[str, tuple[Callable[[CommandParser], None], str, str]] = {
    "raster": (
        configure_raster,
        "speed of the CPU rasterizer, per operation and stage",
        "Time forward, backward and whole training steps of the CPU rasterizer on a procedural room. Optionally "
        "compare with an external rasterizer library in the same run.",
    ),
    "loop": (
        configure_loop,
        "speed and memory of one agent's mapping loop on a sequence",
        "Map a sequence and report latency percentiles of each stage, the frame rate and the memory use. Optionally "
        "measure the quality lost to a frame rate (--unlimited).",
    ),
    "server": (
        configure_server,
        "largest team, memory and times of a fusion server by the size of its map",
        "Fill a fusion server with synthetic updates, and measure acknowledgements of agents that send at 4 Hz, the "
        "snapshot, the status, a restart and the memory.",
    ),
    "chaos": (
        configure_chaos,
        "a fusion server and its agents under kills, partitions, wrong clocks and a full disk",
        "Drive agents and a fusion server through seeded faults. Check after each kill of the server, and at the end, "
        "that every acknowledged voxel is stored, and that the fused map equals the one computed offline.",
    ),
    "fuzz": (
        configure_fuzz,
        "mutated messages for the codec and for every method of the services",
        "Mutate valid messages. Decode most of them in this process, and send the others to every method of a fusion "
        "server, an agent and a parser. No message may crash a program, take over a second, or make its memory grow.",
    ),
    "gpu": (
        configure_gpu,
        "training speed of the CUDA backend, compared with gsplat",
        "Time training iterations of the CUDA backend and of a plain gsplat training loop, and one mapped frame.",
    ),
    "parser": (
        configure_parser,
        "accuracy and speed of a task parser",
        "Parse sentences with known task graphs and report the share of correct graphs and the time per sentence.",
    ),
    "perception": (
        configure_perception,
        "accuracy of a detector's masks against ground truth",
        "Compare the masks of a detector with ground truth after each stage of perception: detection, relations, "
        "evidence and tracking.",
    ),
    "quality": (
        configure_quality,
        "map quality of every policy at an equal budget",
        "Map scenes with several policies and score the maps on held-out views. The budget per frame is equal: "
        "iterations or time.",
    ),
    "ablation": (
        configure_ablation,
        "map quality with the paper's components enabled one by one",
        "Map scenes while enabling the components of the method one after the other, and score the maps on held-out "
        "views.",
    ),
    "team": (
        configure_team,
        "quality of the fused map of several agents, by strategy and policy",
        "Map one home with several agents and tasks. Fuse their maps by concatenation, by the vote and with a joint "
        "refinement, and score the fused maps on held-out views.",
    ),
    "view": (
        configure_view,
        "loading time and frame rate of the live view in a headless browser",
        "Serve synthetic maps on the page of `gausslite view`, open it in a headless Chromium with software rendering, "
        "and measure the time until the map is drawn and the frame rates at rest and while the camera moves.",
    ),
    "places": (
        configure_places,
        "frames of a sequence that are localised in a saved map",
        "Localise each frame in the map of a run, from any start. Report how many poses are right, wrong and refused, "
        "the time, and after how many frames a run is localised. With mirrored images, or in another place, every pose "
        "is wrong. --loops presents the frames as keyframes that may close a loop instead.",
    ),
}


def configure(parser: CommandParser) -> None:
    """Add the benchmarks and their options."""
    benchmarks = parser.add_subparsers(dest="bench", required=True, metavar="BENCHMARK")
    for name, (configure_benchmark, summary, description) in _BENCHMARKS.items():
        configure_benchmark(benchmarks.add_parser(name, help=summary, description=description))
