"""`gausslite bench codec`: bytes a Gaussian, lost PSNR and time of the subset codec beside other formats."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import asdict
from typing import Any

from tqdm import tqdm

from gausslite.cli.progress import progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import split_names
from gausslite.mission.results import as_text, prepare_folder, write_json
from gausslite_bench.cli.study_options import add_study_options, scene_plans
from gausslite_bench.codec.formats import codec_formats
from gausslite_bench.codec.scores import CodecScore, codec_table, measure_formats
from gausslite_bench.quality.trials import Conditions, Trial, TrialBudget, Variant, build_map

_DEFAULT_TASK = "home-5-manipulation"
_POLICY = "task"


def configure_codec(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench codec`."""
    parser.add_argument(
        "--pairs",
        metavar="A,B",
        type=split_names,
        default=(),
        help=f"homes or pairs of a home and a task (default: {_DEFAULT_TASK})",
    )
    parser.add_argument(
        "--max-gaussians", metavar="N", type=int, default=60_000, help="hard cap of the map (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    add_study_options(parser, (0,))
    parser.set_defaults(run=run_codec)


def run_codec(options: argparse.Namespace) -> int:
    """Map each scene, measure the formats, write codec.md and codec.json and print the table."""
    plans, size = scene_plans(options, options.pairs, (_DEFAULT_TASK,))
    formats = codec_formats()
    prepare_folder(options.out)
    scores: list[CodecScore] = []
    with progress_bar(0, "codec", "frame") as bar:
        for plan in plans:
            scene = plan.load(size)
            for seed in options.seeds:
                bar.total = (bar.total or 0) + len(scene.training)
                budget = TrialBudget(options.max_gaussians)
                trial = Trial(plan, Variant(_POLICY, _POLICY), budget, seed, Conditions(size, threads=options.threads))
                trial_map = build_map(trial, scene, lambda _: _count(bar))
                scores += measure_formats(plan.name, trial_map.gaussians, scene.held_out, formats, options.threads)
    command = shlex.join(["gausslite", *sys.argv[1:]])
    report = {"command": command, "scores": [asdict(score) for score in scores]}
    write_atomic(options.out / "codec.md", f"# bench codec\n\n`{command}`\n\n{codec_table(scores)}\n".encode())
    write_json(options.out / "codec.json", report)
    print(as_text(report) if options.json else codec_table(scores))
    return 0


def _count(bar: tqdm[Any]) -> None:
    bar.update()
