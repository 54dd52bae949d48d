"""Declare SOURCE and regions of space as options, and open the sequence, with messages on stderr."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.calibration.camera_estimate import estimate_camera
from gausslite.calibration.pose_exposure_error import estimate_pose_exposure_prior
from gausslite.calibration.registration import find_registration
from gausslite.config.source_options import add_frames
from gausslite.config.values import AUTO, NONE, read_names, read_numbers
from gausslite.datasets.corrected_source import CorrectedSource
from gausslite.datasets.open import has_exact_poses, is_simulated, open_source
from gausslite.datasets.registered_source import RegisteredSource
from gausslite.datasets.ros.bag_source import BagSource
from gausslite.datasets.source import Source
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.pose import UpAxis
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.domain.region import BallRegion, Region
from gausslite.mission.frame_stream import region_file_note
from gausslite.process.messages import print_message


def add_source(parser: argparse.ArgumentParser, default_text: str = NONE) -> None:
    """Add SOURCE and the options of its frames; default_text as in `add_frames`."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help='a folder (TUM, 7-Scenes, Replica, ZED or Record3D layout), a ROS bag ("bag:run1.mcap?depth=TOPIC"), '
        'or "sim:home?seed=0&trajectory=0", sim:home-1 to sim:home-8',
    )
    add_frames(parser, allow_auto=True, default_text=default_text)


def open_with_warnings(
    spec: str,
    up_axis: UpAxis | None,
    depth_registration: DepthRegistration | str | None,
    default: str = NONE,
) -> tuple[Source, DepthRegistration | None]:
    """Open a sequence and return it with the colour camera that its depth is registered to, None for no registration.

    depth_registration: a camera, AUTO, NONE, or None if the user did not set it; then default applies, AUTO or NONE.
    Messages about the sequence go to stderr. Raises DatasetError, PoseError, InvalidInputError.
    """
    return register_with_warnings(spec, open_recorded(spec, up_axis), depth_registration, default)


def open_recorded(spec: str, up_axis: UpAxis | None, require_poses: bool = True) -> Source:
    """Open a sequence without registration; report the topics of a bag, and excluded frames.

    Raises DatasetError, InvalidInputError.
    """
    source = open_source(spec, up_axis, require_poses=require_poses)
    if isinstance(source, BagSource):
        print_message(f"{spec}: {source.description}")
    if source.excluded_frames:
        print_message(f"{spec}: {source.excluded_frames}")
    return source


def register_with_warnings(
    spec: str, source: Source, depth_registration: DepthRegistration | str | None, default: str
) -> tuple[Source, DepthRegistration | None]:
    """Register the depth of an opened sequence as in `open_with_warnings`; an estimate (AUTO) takes seconds."""
    if depth_registration is None and not source.depth_registered:
        depth_registration = default
        hint = f"--register-depth {AUTO} estimates the registration, {NONE} uses depth as recorded"
        if default == AUTO:
            hint = f"the registration is estimated now, --register-depth {NONE} uses depth as recorded"
        print_message(f"{spec}: this layout does not state whether depth is registered to colour; {hint}")
    if depth_registration == AUTO:
        depth_registration, reason = find_registration(source)
        print_message(f"--register-depth {depth_registration or NONE}: {reason}")
    if not isinstance(depth_registration, DepthRegistration):
        return source, None
    return RegisteredSource(source, depth_registration), depth_registration


def correct_with_warnings(
    spec: str, source: Source, correction: CameraCorrection | str | None
) -> tuple[Source, CameraCorrection | None]:
    """Correct a registered source's lens, rolling shutter, time offset and blur; None if images are used as recorded.

    correction: a correction, AUTO, or None if the user did not set it: AUTO then, except for a simulated home, which is
    exact. An estimate (AUTO) takes seconds. Raises DatasetError, PoseError.
    """
    if correction is None:
        correction = CameraCorrection() if is_simulated(spec) else AUTO
    if isinstance(correction, str) and not source.depth_registered:
        correction, reason = CameraCorrection(), "depth is not registered to colour"
        print_message(f"--camera-correction {NONE}: {reason}")
    elif isinstance(correction, str):
        estimate = estimate_camera(source, CameraCorrection(source.lens))
        correction = estimate.correction
        reason = "; ".join(estimate.evidence)
        print_message(f"--camera-correction '{NONE if correction.is_identity else correction}': {reason}")
    if correction.is_identity:
        return source, None
    return CorrectedSource(source, correction), correction


def resolve_pose_prior(spec: str, source: Source, pose_prior: PoseExposurePrior | str) -> PoseExposurePrior:
    """Return the given prior or, for AUTO, an estimate from the recording, which is printed to stderr.

    Poses of a simulated home without drift are exact.
    """
    if isinstance(pose_prior, PoseExposurePrior):
        return pose_prior
    if has_exact_poses(spec):
        return PoseExposurePrior()
    estimate, reason = estimate_pose_exposure_prior(source)
    print_message(f"--pose-prior {NONE if estimate.is_exact else estimate}: {reason}")
    return estimate


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
