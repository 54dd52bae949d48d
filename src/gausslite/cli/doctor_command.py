"""`gausslite doctor`: check the machine and the installation, one line for each part, without network access."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.doctor.check import Check
from gausslite.cli.doctor.extra_checks import extra_checks
from gausslite.cli.doctor.machine_checks import machine_checks
from gausslite.cli.doctor.model_checks import model_checks
from gausslite.cli.doctor.rasterizer_checks import rasterizer_checks
from gausslite.config.values import read_path
from gausslite.process.messages import printable


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite doctor`."""
    parser.epilog = "Exit code: 0 if no line is an error, else 1. No data leaves the machine."
    for flag, default, purpose in (("--folder", "models", "model files"), ("--out", ".", "results of runs")):
        help_text = f"folder of the {purpose} (default: %(default)s)"
        parser.add_argument(flag, metavar="DIR", type=read_path, default=Path(default), help=help_text)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the checks. Returns 1 if one is an error, else 0."""
    checks = []
    for check in _all_checks(options):
        checks.append(check)
        if not options.json:
            print(printable(check.line()), flush=True)
    has_error = any(check.status == "error" for check in checks)
    if options.json:
        print(json.dumps({"ok": not has_error, "checks": [asdict(check) for check in checks]}))
    return int(has_error)


def _all_checks(options: argparse.Namespace) -> Iterator[Check]:
    yield from machine_checks(options.out)
    yield from rasterizer_checks()
    yield from model_checks(options.folder)
    yield from extra_checks()
