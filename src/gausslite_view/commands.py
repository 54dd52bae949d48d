"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

REPORT: Final = Command(
    "show the results of one or several runs on one HTML page: pictures, plots and tables",
    "gausslite_view.report_command",
)

VIEW: Final = Command(
    "show a map, a run, an agent or a fusion server on a page in the browser",
    "gausslite_view.view_command",
)
