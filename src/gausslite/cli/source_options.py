"""Declare SOURCE and regions of space as options, and open the sequence, with messages on stderr."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.calibration.calibrate import Calibration, Evidence, StatedValues, calibrate
from gausslite.config.source_options import add_frames
from gausslite.config.values import NONE, read_names, read_numbers
from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.pose import UpAxis
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.domain.region import BallRegion, Region
from gausslite.mission.frame_stream import region_file_note
from gausslite.process.messages import print_message
from gausslite.process.siblings import Sibling, sibling


def add_source(parser: argparse.ArgumentParser, default_text: str) -> None:
    """Add SOURCE and the options of its frames; default_text as in `add_frames`."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help='a folder (TUM, 7-Scenes, Replica, ZED or Record3D layout), a ROS bag ("bag:run1.mcap?depth=TOPIC"), '
        'or "sim:home?seed=0&trajectory=0", sim:home-1 to sim:home-8',
    )
    add_frames(parser, allow_auto=True, default_text=default_text)


def open_recorded(spec: str, up_axis: UpAxis | None, require_poses: bool = True) -> Source:
    """Open a sequence without registration; report the topics of a bag, and excluded frames.

    Raises DatasetError, InvalidInputError.
    """
    source = open_source(spec, up_axis, require_poses=require_poses)
    if isinstance(source, sibling(Sibling.BAGS).BagSource):
        print_message(f"{spec}: {source.description}")
    if source.excluded_frames:
        print_message(f"{spec}: {source.excluded_frames}")
    return source


def stated_values(
    registration: DepthRegistration | str | None,
    correction: CameraCorrection | str | None,
    pose_prior: PoseExposurePrior | str | None,
) -> StatedValues:
    """Return what the options state: AUTO and None state nothing, NONE states that depth is used as recorded."""
    return StatedValues(
        registration if isinstance(registration, DepthRegistration) else None,
        registration == NONE,
        correction if isinstance(correction, CameraCorrection) else None,
        pose_prior=pose_prior if isinstance(pose_prior, PoseExposurePrior) else None,
    )


def calibrate_with_messages(spec: str, source: Source, stated: StatedValues) -> Calibration:
    """Calibrate an opened sequence as `calibrate` does; each estimate and its reason go to stderr."""
    if not source.depth_registered and stated.registration is None and not stated.depth_as_recorded:
        print_message(
            f"{spec}: this layout does not state whether depth is registered to colour; the registration is estimated "
            f"now, --register-depth {NONE} uses depth as recorded"
        )
    return calibrate(source, stated, _report_estimate)


def _report_estimate(evidence: Evidence) -> None:
    if not evidence.guaranteed:
        print_message(f"--{evidence}")


def add_regions(parser: argparse.ArgumentParser) -> None:
    """Add --roi, --objects and --roi-ball: ground-truth regions of space."""
    parser.add_argument("--roi", metavar="FILE.npz", type=Path, help="voxel file of ground-truth regions")
    parser.add_argument(
        "--objects", metavar="A,B", type=read_names, default=(), help="objects of --roi (default: all) or of SOURCE"
    )
    parser.add_argument(
        "--roi-ball",
        metavar="X,Y,Z,R",
        type=read_ball,
        action="append",
        default=[],
        help="a ball in metres; may be repeated",
    )


def read_ball(text: str) -> BallRegion:
    """Return the ball of "x,y,z,r" in metres. Raises ArgumentTypeError."""
    x, y, z, radius_m = read_numbers(text, 4)
    if radius_m <= 0:
        raise argparse.ArgumentTypeError(f"expected a radius above 0, got {radius_m}")
    return BallRegion((x, y, z), radius_m)


def selected_regions(options: argparse.Namespace, source: Source) -> list[Region]:
    """Return the objects of --roi (those of --objects, or all) and every --roi-ball.

    --objects without --roi selects regions of the source. Empty if the user selects nothing. Raises
    InvalidInputError, DatasetError.
    """
    from gausslite.datasets.regions import balls_for_small_objects, choose_regions, load_voxel_regions

    regions: list[Region] = []
    if options.roi is not None:
        regions += choose_regions(balls_for_small_objects(load_voxel_regions(options.roi)), options.objects)
    elif options.objects:
        report_region_file(options.source, source)
        regions += choose_regions(source.regions(), options.objects)
    return [*regions, *options.roi_ball]


def report_region_file(spec: str, source: Source) -> None:
    """Report that ground-truth regions come from a file of the sequence's folder, if there is one."""
    note = region_file_note(spec, source)
    if note is not None:
        print_message(note)
