"""Options that several sub-commands share beside those of a mission: the sequence and ground-truth regions."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.datasets.source import Source
from gausslite.domain.region import BallRegion, Region
from gausslite.mission.options import add_frames, names, numbers


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add SOURCE and what of it is used."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help='a folder (TUM, 7-Scenes or Replica layout) or "sim:home?seed=0&trajectory=0", sim:home-1 to sim:home-8',
    )
    add_frames(parser)


def add_regions(parser: argparse.ArgumentParser) -> None:
    """Add --roi, --objects and --roi-ball: ground-truth regions of space."""
    parser.add_argument("--roi", metavar="FILE.npz", type=Path, help="voxel file of ground-truth regions")
    parser.add_argument(
        "--objects", metavar="A,B", type=names, default=(), help="objects of --roi (default: all) or of SOURCE"
    )
    parser.add_argument(
        "--roi-ball",
        metavar="X,Y,Z,R",
        type=ball,
        action="append",
        default=[],
        help="a ball in metres; may be repeated",
    )


def ball(text: str) -> BallRegion:
    """Read "x,y,z,r" in metres; argparse reports what is wrong."""
    x, y, z, radius_m = numbers(text, 4)
    if radius_m <= 0:
        raise argparse.ArgumentTypeError(f"expected a radius above 0, got {radius_m}")
    return BallRegion((x, y, z), radius_m)


def asked_regions(options: argparse.Namespace, source: Source) -> list[Region]:
    """The objects of --roi (those of --objects, or all) and every --roi-ball; --objects alone names the source's own.

    Empty when none is asked for. Raises InvalidInputError, DatasetError.
    """
    from gausslite.datasets.regions import balls_for_small_objects, choose_regions, load_voxel_regions

    asked: list[Region] = []
    if options.roi is not None:
        asked += choose_regions(balls_for_small_objects(load_voxel_regions(options.roi)), options.objects)
    elif options.objects:
        asked += choose_regions(source.regions(), options.objects)
    balls: list[BallRegion] = options.roi_ball
    return [*asked, *balls]
