"""Options that several sub-commands share, and how their texts become values."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from gausslite.datasets.source import UpAxis
from gausslite.domain.region import BallRegion, Region
from gausslite.errors import InvalidInputError


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add SOURCE, --frames, --size and --up."""
    parser.add_argument(
        "source", metavar="SOURCE", help='a folder (TUM, 7-Scenes or Replica layout) or "sim:home?seed=0&trajectory=0"'
    )
    parser.add_argument("--frames", metavar="START:STOP:STEP", default=":", help="frame numbers to use (default: all)")
    parser.add_argument("--size", metavar="WxH", help="resize images to this size (default: as they are)")
    parser.add_argument("--up", metavar="X,Y,Z", type=up_axis, help="the world's upward direction, if not the source's")


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


def add_mapping(parser: argparse.ArgumentParser, max_gaussians: int) -> None:
    """Add the budget, the iterations and the seed."""
    parser.add_argument("--max-gaussians", metavar="N", type=int, default=max_gaussians, help="hard cap of the map")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--iterations", metavar="N", type=int, help="iterations a frame (default: 8)")
    budget.add_argument("--rate", metavar="HZ", type=float, help="frames a second: as many iterations as fit")
    parser.add_argument("--seed", metavar="S", type=int, default=0, help="seed of every random choice (default: 0)")
    parser.add_argument("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")


def names(text: str) -> tuple[str, ...]:
    """Split "a,b"."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def ball(text: str) -> BallRegion:
    """Read "x,y,z,r" in metres; argparse reports what is wrong."""
    x, y, z, radius_m = _numbers(text, 4)
    if radius_m <= 0:
        raise argparse.ArgumentTypeError(f"expected a radius above 0, got {radius_m}")
    return BallRegion((x, y, z), radius_m)


def up_axis(text: str) -> UpAxis:
    """Read "x,y,z"; argparse reports what is wrong."""
    x, y, z = _numbers(text, 3)
    return (x, y, z)


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


def _numbers(text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) < float("inf") for value in values):
        raise argparse.ArgumentTypeError(f"expected {count} finite numbers separated by commas, got {text!r}")
    return values
