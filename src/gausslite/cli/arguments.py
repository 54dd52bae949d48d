"""Options that several sub-commands share beside those of a mission: the sequence and ground-truth regions."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from gausslite.domain.region import BallRegion, Region
from gausslite.errors import InvalidInputError
from gausslite.mission.options import add_frames, names, numbers


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add SOURCE and what of it is used."""
    parser.add_argument(
        "source", metavar="SOURCE", help='a folder (TUM, 7-Scenes or Replica layout) or "sim:home?seed=0&trajectory=0"'
    )
    add_frames(parser)


def add_regions(parser: argparse.ArgumentParser) -> None:
    """Add --roi, --objects and --roi-ball: ground-truth regions of space."""
    parser.add_argument("--roi", metavar="FILE.npz", type=Path, help="voxel file of ground-truth regions")
    parser.add_argument("--objects", metavar="A,B", type=names, default=(), help="objects of --roi (default: all)")
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


def named_regions(options: argparse.Namespace) -> Mapping[str, Region]:
    """Regions given by --roi and --roi-ball, by name. Raises InvalidInputError, DatasetError."""
    from gausslite.datasets.regions import balls_for_small_objects, load_voxel_regions

    regions: dict[str, Region] = {}
    if options.roi is not None:
        regions.update(balls_for_small_objects(load_voxel_regions(options.roi)))
    elif options.objects:
        raise InvalidInputError("--objects: names objects of a voxel file; give the file with --roi FILE.npz")
    regions.update({f"ball_{i + 1}": region for i, region in enumerate(options.roi_ball)})
    return regions
