"""Entry of `gausslite`: choose the sub-command, turn deliberate errors into one line and exit code 2."""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import os
import sys
from collections.abc import Sequence

from gausslite import __version__
from gausslite.errors import GaussLiteError
from gausslite.interrupts import Terminated, started

_COMMANDS = {
    "map": "map one sequence for one task, write map.ply, report.json and preview.png",
    "demo": "run parser, fusion server and two agents as real processes, fuse and score their maps",
    "parse": "read a task sentence into targets, anchors and relations",
    "eval": "score a map on frames of a sequence, inside regions and over the whole image",
    "fuse": "vote several map files into one, voxel by voxel",
    "models": "list, fetch, verify and inspect the model files that find and outline objects",
    "bench": "measure the rasterizer, the whole mapping loop, the GPU, the quality of maps, or a task parser",
}
_MODULES = {name: f"gausslite.cli.{name}_command" for name in _COMMANDS} | {"bench": "gausslite_bench.cli.main"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a path or a language that the terminal cannot show must not end hours of work
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return _dispatch(arguments)
    except GaussLiteError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(_describe(error))
    except Terminated:
        print("gausslite: terminated", file=sys.stderr)
        return 143
    except KeyboardInterrupt:
        print("gausslite: interrupted", file=sys.stderr)
        return 130


def _dispatch(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="gausslite", description="Online 3D Gaussian maps that follow the task.")
    parser.add_argument("--version", action="version", version=f"gausslite {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((word for word in arguments if not word.startswith("-")), None)
    for name, summary in _COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name == chosen:  # the heavy imports of the others stay untouched
            importlib.import_module(_MODULES[name]).configure(command)
    options = parser.parse_args(arguments)
    run = options.run
    # from here on there is work to clean up after
    started()
    return int(run(options))


def _fail(message: str) -> int:
    print(f"gausslite: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _describe(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"{where}the disk is full; free some space or choose another --out"
    if error.errno == errno.EPIPE:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return f"{where}{error.strerror or error}"
