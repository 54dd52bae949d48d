"""Entry of `gausslite`: choose the sub-command; report expected errors in one line with exit code 2."""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import os
import sys
from collections.abc import Mapping, Sequence

from gausslite.domain.errors import GaussLiteError
from gausslite.process.interrupts import Terminated, raise_interrupts
from gausslite.process.messages import print_message

_COMMANDS = {
    "map": "map a sequence for a task; write map.ply, report.json and preview.png",
    "demo": "run a task parser, a fusion server and two agents as processes; fuse and score their maps",
    "parse": "parse a task sentence into targets, anchors and relations",
    "eval": "score a map on frames of a sequence, in the region of interest (ROI) and over whole images",
    "calibrate": "estimate the camera of a recording: depth registration, lens, rolling shutter, times, pose errors",
    "fuse": "fuse map files into one by a vote in every voxel",
    "export": "write a map for other tools: splat viewers, point clouds, planners, meshes",
    "report": "show the results of one or several runs on one HTML page: pictures, plots and tables",
    "view": "show a map, a run, an agent or a fusion server on a page in the browser",
    "status": "print the state of a running agent or fusion server",
    "end": "end the mission of a running agent: send what waits, hand over, save",
    "refine": "refine the fused map of a running team",
    "fetch": "download the fused map of a running team",
    "evict": "delete the data of an agent from a fusion server, and keep it out on request",
    "unban": "let a banned agent join a fusion server again",
    "objects": "print where the objects of a task are, from a fusion server or from the report of a run",
    "models": "list, download, verify and inspect model files for detection and segmentation",
    "doctor": "check the machine and the installation: CPU, GPU, memory, disk, clock, ports, models, extras",
    "bench": "measure the rasterizer, the mapping loop, the GPU, map quality or a task parser",
}
_CONFIGURABLE = frozenset({"map", "demo", "eval", "bench"})
"""Commands whose options may also come from a configuration file and from the environment."""
_MODULES = {name: f"gausslite.cli.{name}_command" for name in _COMMANDS} | {"bench": "gausslite_bench.cli.main"}


class _PrintVersion(argparse.Action):
    """Print the version of the installed distribution, which is looked up only on request."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"gausslite {version('gausslite')}")
        except PackageNotFoundError:
            print("gausslite from a source tree that is not installed")
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a character that the terminal cannot encode must not end hours of work
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return _dispatch(arguments)
    except GaussLiteError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(_describe(error))
    except Terminated as signal:
        return _interrupted("terminated", signal, 143)
    except KeyboardInterrupt as signal:
        return _interrupted("interrupted", signal, 130)


def _dispatch(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="gausslite", description="Online 3D Gaussian maps that spend their detail on a task."
    )
    parser.add_argument("--version", action=_PrintVersion, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((word for word in arguments if not word.startswith("-")), None)
    for name, summary in _COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name == chosen:  # import only the chosen command: the others need seconds
            importlib.import_module(_MODULES[name]).configure(command)
    options = _parse(parser, commands.choices, arguments)
    run = options.run
    raise_interrupts()
    return int(run(options))


def _parse(
    parser: argparse.ArgumentParser, commands: Mapping[str, argparse.ArgumentParser], arguments: list[str]
) -> argparse.Namespace:
    """Return the options of the chosen command."""
    if not arguments or arguments[0] not in _CONFIGURABLE:
        return parser.parse_args(arguments)
    from gausslite.config.layers import parse_options

    return parse_options(commands[arguments[0]], arguments[1:], warn=print_message)


def _fail(message: str) -> int:
    print_message(f"gausslite: {message}")
    return 2


def _interrupted(event: str, signal: KeyboardInterrupt, code: int) -> int:
    """Report an interrupt, with the text that the command has attached to it; return the exit code."""
    print_message(f"gausslite: {event}{f': {signal}' if str(signal) else ''}")
    return code


def _describe(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    if error.errno == errno.ENOSPC:
        return f"{where}the disk is full; free some space or choose another --out"
    if error.errno == errno.EPIPE:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return f"{where}{error.strerror or error}"
