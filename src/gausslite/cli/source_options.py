"""Options that several sub-commands share beside those of a mission: the sequence and ground-truth regions."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gausslite.calibration.pose_exposure_error import estimate_pose_exposure_prior
from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.calibration.registration import find_registration
from gausslite.config.source_options import add_frames
from gausslite.config.values import AUTO, NONE, read_names, read_numbers
from gausslite.datasets.open import is_simulated, open_source
from gausslite.datasets.registered_source import DepthRegistration, RegisteredSource
from gausslite.datasets.source import Source
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import BallRegion, Region


def add_source(parser: argparse.ArgumentParser, default_text: str = NONE) -> None:
    """Add SOURCE and what of it is used; default_text as in `add_frames`."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help='a folder (TUM, 7-Scenes or Replica layout) or "sim:home?seed=0&trajectory=0", sim:home-1 to sim:home-8',
    )
    add_frames(parser, allow_auto=True, default_text=default_text)


def open_with_warnings(
    spec: str,
    up_axis: UpAxis | None,
    depth_registration: DepthRegistration | str | None,
    default: str = NONE,
) -> tuple[Source, DepthRegistration | None]:
    """Open a sequence and tell, on stderr, what a user would not expect of it; the camera that depth is registered to.

    What is asked for may be AUTO, NONE or None, for nothing; then it is default, one of the two. Raises
    DatasetError, PoseError, InvalidInputError.
    """
    return register_with_warnings(spec, open_recorded(spec, up_axis), depth_registration, default)


def open_recorded(spec: str, up_axis: UpAxis | None) -> Source:
    """Open a sequence as it was recorded and tell what is left out of it. Raises DatasetError, InvalidInputError."""
    source = open_source(spec, up_axis)
    if source.excluded_frames:
        print(f"{spec}: {source.excluded_frames}", file=sys.stderr)
    return source


def register_with_warnings(
    spec: str, source: Source, depth_registration: DepthRegistration | str | None, default: str
) -> tuple[Source, DepthRegistration | None]:
    """The second half of open_with_warnings: bring depth into the colour camera; looking for that takes seconds."""
    if depth_registration is None and not source.depth_registered:
        depth_registration = default
        hint = f"--register-depth {AUTO} looks for the camera to register it to, {NONE} takes it as it is"
        if default == AUTO:
            hint = f"looking for its colour camera now, --register-depth {NONE} takes it as it is"
        print(f"{spec}: its layout leaves open whether depth is registered to colour; {hint}", file=sys.stderr)
    if depth_registration == AUTO:
        depth_registration, why = find_registration(source)
        print(f"--register-depth {depth_registration or NONE}: {why}", file=sys.stderr)
    if not isinstance(depth_registration, DepthRegistration):
        return source, None
    return RegisteredSource(source, depth_registration), depth_registration


def resolve_pose_prior(spec: str, source: Source, pose_prior: PoseExposurePrior | str) -> PoseExposurePrior:
    """How wrong the views may be, as said or, for AUTO, as a recording itself tells; that is told on stderr.

    Poses of a simulated home are exact.
    """
    if isinstance(pose_prior, PoseExposurePrior):
        return pose_prior
    if is_simulated(spec):
        return PoseExposurePrior()
    found, why = estimate_pose_exposure_prior(source)
    print(f"--pose-prior {NONE if found.is_exact else found}: {why}", file=sys.stderr)
    return found


def add_regions(parser: argparse.ArgumentParser) -> None:
    """Add --roi, --objects and --roi-ball: ground-truth regions of space."""
    parser.add_argument("--roi", metavar="FILE.npz", type=Path, help="voxel file of ground-truth regions")
    parser.add_argument(
        "--objects", metavar="A,B", type=read_names, default=(), help="objects of --roi (default: all) or of SOURCE"
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
    x, y, z, radius_m = read_numbers(text, 4)
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
