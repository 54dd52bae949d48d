"""The sub-commands of `gausslite`: names, summaries and modules, and the parser of some or all of them."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from importlib import import_module

from gausslite.config.command_parser import CommandParser
from gausslite.process.siblings import Sibling, sibling

SUMMARIES = {
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
    "completion": "print the completion of commands and options for a shell",
    "doctor": "check the machine and the installation: CPU, GPU, memory, disk, clock, ports, models, extras",
    "bench": "measure the rasterizer, the mapping loop, the GPU, map quality or a task parser",
}
_SIBLINGS = {"report": Sibling.REPORT_COMMAND, "view": Sibling.VIEW_COMMAND, "bench": Sibling.BENCH_COMMAND}


class _PrintVersion(argparse.Action):
    """Print the version of the installed distribution, which is looked up only on request."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"gausslite {version('gausslite')}")
        except PackageNotFoundError:
            print("gausslite from a source tree that is not installed")
        parser.exit()


def build_parser(configured: Collection[str] = tuple(SUMMARIES)) -> CommandParser:
    """Return the parser of `gausslite`. configured: commands that get their options; each imports its module."""
    parser = CommandParser(prog="gausslite", description="Online 3D Gaussian maps that spend their detail on a task.")
    parser.add_argument("--version", action=_PrintVersion, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary in SUMMARIES.items():
        command = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
        if name in configured:
            of_sibling = _SIBLINGS.get(name)
            module = import_module(f"gausslite.cli.{name}_command") if of_sibling is None else sibling(of_sibling)
            module.configure(command)
    return parser
