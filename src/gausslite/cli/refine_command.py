"""`gausslite refine`: refine the fused map of a running team on the keyframes that the server has."""

from __future__ import annotations

import argparse

from gausslite.cli.progress import progress_bar
from gausslite.cli.team_options import add_address, fusion_client
from gausslite.codec.files import write_atomic
from gausslite.config.command_parser import bounded
from gausslite.config.values import read_path
from gausslite.mission.results import MAP_FILE, prepare_file
from gausslite.wire.clients import Export

_MAX_ITERATIONS, _MAX_SEED = 1_000_000, (1 << 63) - 1


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite refine`."""
    add_address(parser, "the fusion server")
    add = parser.add_argument
    add(
        "--iterations",
        metavar="N",
        type=bounded(int, 1, _MAX_ITERATIONS),
        default=0,
        help="training iterations (default: the server's)",
    )
    add(
        "--seed",
        metavar="N",
        type=bounded(int, 0, _MAX_SEED),
        default=0,
        help="seed of the random views (default: %(default)s)",
    )
    add("--out", metavar="FILE.ply", type=read_path, help="also download the refined map to this file")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Refine the map, and show the progress. Ctrl-C cancels the refinement. Returns the exit code.

    Raises MismatchError without a map and keyframes, QuotaError while another refinement runs, UnavailableError.
    """
    if options.out is not None:
        prepare_file(options.out, MAP_FILE)
    gaussians = 0
    with fusion_client(options) as client:
        with progress_bar(options.iterations, "refine", "it") as bar:
            for progress in client.refine(options.iterations, seed=options.seed):
                bar.total, gaussians = progress.iterations, progress.gaussians
                bar.set_postfix_str(f"loss {progress.loss:.4f}", refresh=False)
                bar.update(progress.iteration - bar.n)
        print(f"refined {gaussians} Gaussians")
        if options.out is not None:
            write_atomic(options.out, client.export(Export("refined")))
            print(f"wrote {options.out}")
    return 0
