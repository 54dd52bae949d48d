"""`gausslite view`: show a map, a run, an agent or a fusion server on a page in the browser."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from gausslite.config.command_parser import CommandParser, bounded
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.process import print_message
from gausslite.wire.security import TlsFiles
from gausslite_view.contents import DEFAULT_LIMIT
from gausslite_view.pages import open_page
from gausslite_view.run_contents import read_contents, read_past

_DEFAULT_PORT = 8099


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite view`."""
    add = parser.add_argument
    add("place", metavar="MAP.ply|RUN|HOST:PORT", help="a PLY file, a results folder, an agent or a fusion server")
    add(
        "--port",
        metavar="PORT",
        type=bounded(int, 0, 65535),
        default=_DEFAULT_PORT,
        help=f"port of the page on 127.0.0.1, 0 for a free one (default: {_DEFAULT_PORT})",
    )
    add(
        "--max-shown",
        metavar="N",
        type=bounded(int, 10_000, 2_000_000),
        default=DEFAULT_LIMIT,
        help=f"draw the N most important Gaussians; a slider changes it (default: {DEFAULT_LIMIT})",
    )
    add_flags(parser, TlsFiles)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C. Raises MapFileError, InvalidInputError, UnavailableError, MismatchError."""
    with _show_files(options) if _is_path(options.place) else _follow(options) as url:
        print_message(f"{options.place} is shown at {url}; end with Ctrl-C")
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    return 0


@contextmanager
def _show_files(options: argparse.Namespace) -> Iterator[str]:
    path = Path(options.place)
    contents = read_contents(path)
    past = read_past(path, contents)
    page = open_page(options.port, f"GaussLite {path.resolve().name}", options.max_shown)
    try:
        page.show_run(contents, past)
        yield page.url
    finally:
        page.close()


def _follow(options: argparse.Namespace) -> AbstractContextManager[str]:
    # imported late, because files need no gRPC
    from gausslite.wire.channel import is_agent
    from gausslite_view.pages import live_page

    tls = build(TlsFiles, options).read()
    return live_page(options.port, options.place, is_agent(options.place, tls), tls, options.max_shown)


def _is_path(place: str) -> bool:
    """Return True unless the place can only be an address: HOST:PORT or unix:PATH."""
    if Path(place).exists():
        return True
    return not place.startswith("unix:") and not place.rpartition(":")[2].isdecimal()
