"""The option that shows a running program's map on a page."""

from __future__ import annotations

import argparse

from gausslite.config.numbers import Number


def add_view(parser: argparse.ArgumentParser, shown: str) -> None:
    """Add --view; `shown` names what the page shows."""
    parser.add_argument(
        "--view",
        metavar="PORT",
        type=Number("view", int, 0, 65535),
        help=f"show {shown} on a page at http://127.0.0.1:PORT while it grows; 0 chooses a port (extra: view)",
    )
