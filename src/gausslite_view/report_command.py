"""`gausslite report`: show the results of one or several runs on one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.config.values import read_path
from gausslite.mission.results import REPORT_PAGE, as_text, prepare_folder
from gausslite.process import print_message, size_text
from gausslite_view.report import require_replaceable, write_page
from gausslite_view.report_parts import read_results


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite report`."""
    add = parser.add_argument
    add("runs", metavar="RUN", type=read_path, nargs="+", help="results folders of `map`, of `demo` or of agents")
    add(
        "--out",
        metavar="FILE",
        type=read_path,
        help=f"the page; an earlier report is replaced (default: RUN/{REPORT_PAGE}, ./{REPORT_PAGE} for several runs)",
    )
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read the runs and write the page. Raises MapFileError for a folder without a run, StorageError."""
    out = options.out or (options.runs[0] / REPORT_PAGE if len(options.runs) == 1 else Path(REPORT_PAGE))
    contents = read_results(options.runs)
    for note in (note for run_contents in contents.runs for note in run_contents.notes):
        print_message(note)
    require_replaceable(out)
    prepare_folder(out.absolute().parent)
    size = write_page(out, contents)
    if options.json:
        print(as_text({"file": str(out), "maps": [run_contents.name for run_contents in contents.runs], "bytes": size}))
    else:
        print(f"{', '.join(run_contents.name for run_contents in contents.runs)} → {out} ({size_text(size)})")
    return 0
