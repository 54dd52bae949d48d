#!/usr/bin/env python3
"""Estimate the registration of unregistered depth to colour in a sequence, for the option register-depth.

    tools/estimate_registration.py SOURCE [--frames START:STOP:STEP] [--count 40]

Prints the option's value; the edge scores go to stderr.
"""

from __future__ import annotations

import argparse
import sys

import gausslite as gl
from gausslite.calibration.registration import estimate_depth_registration


def main() -> int:
    parser = argparse.ArgumentParser(description="Estimate the registration of depth to colour from image edges.")
    parser.add_argument("source", metavar="SOURCE", help="a folder (TUM, 7-Scenes or Replica layout)")
    parser.add_argument("--frames", metavar="START:STOP:STEP", default=":", help="frame numbers to use (default: all)")
    parser.add_argument("--count", metavar="N", type=int, default=40, help="number of frames to use (default: 40)")
    options = parser.parse_args()
    try:
        estimate = estimate_depth_registration(gl.open_sequence(options.source), options.frames, options.count)
    except gl.GaussLiteError as error:
        print(f"estimate_registration: {error}", file=sys.stderr)
        return 2
    print(
        f"{estimate.edge_points} depth edge points; colour gradient at them relative to their surroundings: "
        f"{estimate.unregistered_score:.2f} unregistered, {estimate.score:.2f} registered",
        file=sys.stderr,
    )
    print(estimate.registration)
    return 0


if __name__ == "__main__":
    sys.exit(main())
