"""`gausslite view`: show a map, a run, an agent or a fusion server on a page in the browser."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path

from gausslite.config.numbers import Number
from gausslite.process.messages import print_message
from gausslite.view.level_of_detail import DEFAULT_LIMIT
from gausslite.view.open_page import open_page
from gausslite.view.run_contents import read_contents

_DEFAULT_PORT = 8099


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite view`."""
    add = parser.add_argument
    add("place", metavar="MAP.ply|RUN|HOST:PORT", help="a PLY file, a results folder, an agent or a fusion server")
    add(
        "--port",
        metavar="PORT",
        type=Number("port", int, 0, 65535),
        default=_DEFAULT_PORT,
        help=f"port of the page on 127.0.0.1, 0 for a free one (default: {_DEFAULT_PORT})",
    )
    add(
        "--max-shown",
        metavar="N",
        type=Number("max-shown", int, 10_000, 2_000_000),
        default=DEFAULT_LIMIT,
        help=f"draw the N most important Gaussians; a slider changes it (default: {DEFAULT_LIMIT})",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C. Raises MapFileError, InvalidInputError."""
    path = Path(options.place)
    contents = read_contents(path)
    page = open_page(options.port, f"GaussLite {path.name}", options.max_shown)
    try:
        page.show(contents)
        print_message(f"{options.place} is shown at {page.url}; end with Ctrl-C")
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return 0
