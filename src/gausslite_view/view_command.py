"""`gausslite view`: show a map, a run, an agent or a fusion server on a page in the browser."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.config.command_parser import CommandParser, bounded
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.mission.results import read_report
from gausslite.process import print_message
from gausslite.wire.security import TlsFiles
from gausslite_objects.object_memory import RunMemory
from gausslite_view.contents import DEFAULT_LIMIT, ViewContents
from gausslite_view.pages import open_page
from gausslite_view.run_contents import edited_objects, read_contents, read_past

if TYPE_CHECKING:
    from gausslite_view.map_page import MapPage

_DEFAULT_PORT = 8099


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite view`."""
    add = parser.add_argument
    add(
        "place",
        metavar="MAP.ply|RUN|HOST:PORT",
        help="a PLY file, a results folder (a demo's too), an agent or a fusion server",
    )
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
    with show_files(options) if _is_path(options.place) else _follow(options) as url:
        print_message(f"{options.place} is shown at {url}; end with Ctrl-C")
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    return 0


@contextmanager
def show_files(options: argparse.Namespace) -> Iterator[str]:
    """Serve the page of a PLY file or of results; yield its URL. Raises MapFileError, InvalidInputError."""
    path = Path(options.place)
    if path.is_dir() and "agents" in read_report(path):
        with _show_team(path, options) as url:
            yield url
        return
    contents = read_contents(path)
    past = read_past(path, contents)
    page = open_page(options.port, f"GaussLite {path.resolve().name}", options.max_shown)
    try:
        page.show_run(contents, past)
        if path.is_dir():
            _add_objects(page, path, contents)
        yield page.url
    finally:
        page.close()


def _add_objects(page: MapPage, folder: Path, contents: ViewContents) -> None:
    """Let a person correct the run's objects."""
    from gausslite_view.objects_panel import ObjectsPanel

    def show() -> None:
        edited = replace(contents, objects=edited_objects(folder))
        panel.show(edited)
        page.show(edited)

    panel = ObjectsPanel(page, RunMemory(folder), show)
    panel.show(contents)


@contextmanager
def _show_team(folder: Path, options: argparse.Namespace) -> Iterator[str]:
    """Show one map of a demo at a time, the voted one first, with what it is for and what a robot alone lacks."""
    from gausslite_evaluation.compare import TEAM_MAP, map_purpose
    from gausslite_view.report import team_gain
    from gausslite_view.report_parts import read_results

    page = open_page(options.port, f"GaussLite {folder.resolve().name}", options.max_shown)
    try:
        from gausslite_view.map_page import text_html

        runs = {run.name: run for run in read_results([folder]).runs}
        with page.server.gui.add_folder("Team", order=0):
            first = TEAM_MAP if TEAM_MAP in runs else None
            chosen = page.server.gui.add_dropdown("Shown map", list(runs), initial_value=first)
            purpose = page.server.gui.add_html("")
            page.server.gui.add_html(text_html([team_gain(list(runs.values()))]))

        def show() -> None:
            run = runs[chosen.value]
            purpose.content = text_html([map_purpose(run.name, str(run.report.get("task") or ""))])
            page.show(run.contents)

        show()
        chosen.on_update(lambda _: show())
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
