"""`gausslite bench view`: loading time and frame rates of the live view in a headless browser."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from gausslite_bench.cli.argument_types import read_counts, read_image_size
from gausslite_view.contents import DEFAULT_LIMIT

if TYPE_CHECKING:
    from gausslite_bench.view_rates import ViewRate

_GAUSSIANS = (100_000, 1_000_000)


def configure_view(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench view`."""
    add = parser.add_argument
    counts = ",".join(map(str, _GAUSSIANS))
    add("--gaussians", metavar="N,...", type=read_counts, default=_GAUSSIANS, help=f"map sizes (default: {counts})")
    add("--max-shown", metavar="N", type=int, default=DEFAULT_LIMIT, help="Gaussians drawn (default: %(default)s)")
    add("--size", metavar="WxH", type=read_image_size, default=(1280, 720), help="window (default: 1280x720)")
    add("--seconds", metavar="S", type=float, default=10.0, help="length of the drag (default: %(default)g)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run_view)


def run_view(options: argparse.Namespace) -> int:
    """Measure each map in turn."""
    # needs the extra `view`
    from gausslite_bench.view_rates import measure_view

    rates = []
    for count in options.gaussians:
        rates.append(measure_view(count, options.max_shown, options.size, options.seconds))
        if not options.json:
            print(_line(rates[-1]), flush=True)
    if options.json:
        print(json.dumps([rate.as_json() for rate in rates], indent=1))
    return 0


def _line(rate: ViewRate) -> str:
    return (
        f"{rate.gaussians:,} Gaussians at {rate.width_px}x{rate.height_px}: drawn after {rate.drawn_s:.1f} s, a move "
        f"answered after {rate.interactive_s:.1f} s, {rate.shown:,} drawn from {rate.settled_s:.1f} s on: "
        f"{rate.response_s:.2f} s to answer a move, then {rate.moving_fps:.1f} frames a second"
    )
