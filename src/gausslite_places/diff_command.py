"""`gausslite diff`: say what changed between the maps of two runs of one place."""

from __future__ import annotations

import argparse
import json
from dataclasses import MISSING, dataclass
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite_places.map_diff import Change
from gausslite_places.prior_map import SavedMap, compare_runs


@dataclass(frozen=True, slots=True)
class DiffOptions:
    """The options of `gausslite diff`."""

    before: Path = option(MISSING, "folder of the earlier run", metavar="RUN_A")
    after: Path = option(MISSING, "folder of the later run", metavar="RUN_B")
    json: bool = option(False, "print JSON for scripts")


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite diff`."""
    Program.of(DiffOptions, flags="json", positional="before after").add_to(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare the runs and print what changed. Returns the exit code."""
    changes = compare_runs(SavedMap.read(options.before), SavedMap.read(options.after))
    if options.json:
        print(json.dumps({"changes": [change.as_json() for change in changes]}))
    else:
        print("\n".join(map(Change.describe, changes)) or "nothing changed that both runs saw")
    return 0
