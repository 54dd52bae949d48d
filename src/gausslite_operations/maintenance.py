"""The commands of `gausslite-fusion-server` that maintain a store's file: backup, restore, verify."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.domain.errors import GaussLiteError
from gausslite.process import print_message
from gausslite_fusion_server.settings import PROGRAM
from gausslite_operations.store_maintenance import StoreReport, back_up, restore, verify

_COMMANDS = (
    ("backup", ("store", "target"), "copy a store to a new file and verify the copy; a server may be using it"),
    ("restore", ("backup", "store"), "replace a store by a backup; the earlier file is kept under another name"),
    ("verify", ("store",), "check every row; a server may be using the store"),
)


def run(arguments: Sequence[str]) -> int:
    """Run a command and print what it did; return 0, 1 for damaged rows, 2 with one line on stderr."""
    options = _parser().parse_args(arguments)
    try:
        return _run(options)
    except (GaussLiteError, OSError) as error:
        print_message(f"{PROGRAM} {options.command}: {error}")
        return 2


def _run(options: argparse.Namespace) -> int:
    match options.command:
        case "backup":
            report = back_up(options.store, options.target)
            _print(options, f"{options.target}: {_summary(report)}", dataclasses.asdict(report))
        case "restore":
            report, replaced = restore(options.backup, options.store)
            earlier = "" if replaced is None else f"; the earlier file is now {replaced}"
            text = f"{options.store}: {_summary(report)}; agents will send what is missing{earlier}"
            _print(options, text, dataclasses.asdict(report) | {"replaced": str(replaced or "")})
        case _:
            report = verify(options.store, options.repair)
            done = " deleted; agents will send what is missing" if options.repair and report.damaged_rows else ""
            done += f"; rows on damaged pages are gone, the file before is {report.replaced}" if report.replaced else ""
            text = f"{options.store}: {_summary(report)}, {report.damaged_rows} damaged rows{done}"
            _print(options, text, dataclasses.asdict(report))
            return int(report.damaged_rows > 0 and not options.repair)
    return 0


def _summary(report: StoreReport) -> str:
    return f"{report.agents} agents, {report.voxels} voxels, {report.gaussians} Gaussians, {report.keyframes} keyframes"


def _print(options: argparse.Namespace, text: str, values: dict[str, object]) -> None:
    sys.stdout.write((json.dumps(values) if options.json else text) + "\n")


def _parser() -> CommandParser:
    parser = CommandParser(prog=PROGRAM, description="Maintain the file of a store.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, paths, text in _COMMANDS:
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        for path in paths:
            command.add_argument(path, type=Path, metavar=path.upper())
        command.add_argument("--json", action="store_true", help="print one JSON object")
        if name == "verify":
            command.add_argument("--repair", action="store_true", help="keep only what is intact; without a server")
    return parser
