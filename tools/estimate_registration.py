#!/usr/bin/env python3
"""Find the colour camera of a sequence whose depth is not registered to colour, for the option --register-depth.

    tools/estimate_registration.py SOURCE [--frames START:STOP:STEP] [--count 40]

Prints the option's text; how sure it is goes to stderr.
"""

from __future__ import annotations

import argparse
import sys

from gausslite.calibration.registration import estimate_depth_registration
from gausslite.datasets.open import open_source
from gausslite.datasets.selection import select_frames
from gausslite.errors import GaussLiteError


def main() -> int:
    parser = argparse.ArgumentParser(description="Find the colour camera of a sequence from the edges in its images.")
    parser.add_argument("source", metavar="SOURCE", help="a folder (TUM, 7-Scenes or Replica layout)")
    parser.add_argument("--frames", metavar="START:STOP:STEP", default=":", help="frame numbers to use (default: all)")
    parser.add_argument("--count", metavar="N", type=int, default=40, help="of these, how many (default: 40)")
    options = parser.parse_args()
    try:
        source = open_source(options.source)
        positions = select_frames(source, options.frames)
        found = estimate_depth_registration(source, positions, options.count)
    except GaussLiteError as error:
        print(f"estimate_registration: {error}", file=sys.stderr)
        return 2
    print(
        f"{found.edge_points} depth edge points; colour's gradient there is "
        f"{found.unregistered_score:.2f} times its surroundings as it is, {found.score:.2f} times with this camera",
        file=sys.stderr,
    )
    print(found.registration)
    return 0


if __name__ == "__main__":
    sys.exit(main())
