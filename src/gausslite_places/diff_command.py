"""`gausslite diff`: say what changed between the maps of two runs of one place."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite_objects.changes import Change
from gausslite_places.prior_map import SavedMap, compare_runs


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite diff`."""
    parser.add_argument("before", type=Path, metavar="RUN_A", help="folder of the earlier run")
    parser.add_argument("after", type=Path, metavar="RUN_B", help="folder of the later run")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare the runs and print what changed. Returns the exit code."""
    changes = compare_runs(SavedMap.read(options.before), SavedMap.read(options.after))
    if options.json:
        print(json.dumps({"changes": [change.as_json() for change in changes]}))
    else:
        print("\n".join(map(Change.describe, changes)) or "no change in what both runs saw")
    return 0
