"""`gausslite-fusion-server backup | restore | verify | compact`: maintain the file of a store."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from gausslite.domain.errors import GaussLiteError
from gausslite.fusion import store_maintenance
from gausslite.fusion.store_maintenance import StoreReport
from gausslite.process.messages import print_message

_PROGRAM = "gausslite-fusion-server"
COMMANDS = ("backup", "restore", "verify", "compact")


def run_command(arguments: Sequence[str]) -> int:
    """Run one of COMMANDS and print what it did; returns 0, 1 for damaged rows, or 2 with one line on stderr."""
    options = _parser().parse_args(arguments)
    try:
        return _run(options)
    except (GaussLiteError, OSError) as error:
        print_message(f"{_PROGRAM} {options.command}: {error}")
        return 2


def _run(options: argparse.Namespace) -> int:
    match options.command:
        case "backup":
            report = store_maintenance.back_up(options.store, options.target)
            _print(options, f"{options.target}: {_summary(report)}", dataclasses.asdict(report))
        case "restore":
            report, replaced = store_maintenance.restore(options.backup, options.store)
            earlier = "" if replaced is None else f"; the earlier file is now {replaced}"
            text = f"{options.store}: {_summary(report)}; agents will send everything again{earlier}"
            _print(options, text, dataclasses.asdict(report) | {"replaced": str(replaced or "")})
        case "verify":
            report = store_maintenance.verify(options.store, options.repair)
            done = " deleted; agents will send everything again" if options.repair and report.damaged_rows else ""
            text = f"{options.store}: {_summary(report)}, {report.damaged_rows} damaged rows{done}"
            _print(options, text, dataclasses.asdict(report))
            return int(report.damaged_rows > 0 and not options.repair)
        case _:
            before, after = store_maintenance.compact(options.store)
            _print(
                options, f"{options.store}: {before} bytes before, {after} after", {"before": before, "after": after}
            )
    return 0


def _summary(report: StoreReport) -> str:
    return f"{report.agents} agents, {report.voxels} voxels, {report.gaussians} Gaussians, {report.keyframes} keyframes"


def _print(options: argparse.Namespace, text: str, values: dict[str, object]) -> None:
    sys.stdout.write((json.dumps(values) if options.json else text) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=_PROGRAM, description="Maintain the file of a store.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, paths, text in (
        ("backup", ("store", "target"), "copy a store to a new file and verify the copy; a server may be using it"),
        ("restore", ("backup", "store"), "replace a store by a backup; the earlier file is kept under another name"),
        ("verify", ("store",), "check every row; a server may be using the store"),
        ("compact", ("store",), "rewrite the file without unused space; no server may be using it"),
    ):
        command = commands.add_parser(name, help=text, description=text.capitalize() + ".")
        for path in paths:
            command.add_argument(path, type=Path, metavar=path.upper())
        command.add_argument("--json", action="store_true", help="print one JSON object")
        if name == "verify":
            command.add_argument("--repair", action="store_true", help="delete the damaged rows; without a server")
    return parser
