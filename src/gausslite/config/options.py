"""The options that `gausslite` and `gausslite-agent` share: one spelling, one default, one way into settings."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.domain.pose import UpAxis
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.policies import ABLATION_FLAGS, POLICIES
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.mission.settings import DEFAULT_MAX_GAUSSIANS, MissionSettings, PerceptionSettings
from gausslite.render.choose import BACKENDS

_DETECTOR_HELP = "a YOLO-seg or Grounding DINO model (default: the source's ground truth)"
_TRUSTED = PoseExposurePrior()
LOOK, AS_RECORDED = "auto", "none"
TRUSTED = AS_RECORDED
_COLOUR_CAMERA_METAVAR = "FX,FY,CX,CY[,TX,TY,TZ[,RX,RY,RZ]]"
_COLOUR_CAMERA_HELP = (
    "register depth to this camera (pixels as data sets count); then where the depth camera sits seen from it "
    "(metres) and how it is turned (rotation vector, degrees)"
)
_LOOK_HELP = (
    "; none: as recorded; auto: found from the images' edges where the layout does not register depth, such as "
    "7-Scenes (default: {})"
)
_VIEW_ERROR_METAVAR = "M,DEG[,GAIN,OFFSET]"
_VIEW_ERROR_HELP = (
    "how wrong poses (and colours, from 0 to 1) may be; keyframes are refined within that; none: they are trusted{} "
    "(default: {})"
)
_MEASURE_HELP = "; auto: measured on pairs of a recording's frames"
_RELIEF_HELP = "what gives way, in order, where that time is short (default: publishing,seeding)"
_RUN_OVER_HELP = "by what share of its time a frame that is short of them may be late (default: %(default)s)"


def add_frames(parser: argparse.ArgumentParser, may_look: bool = False, by_default: str = AS_RECORDED) -> None:
    """Add --frames, --size, --up and --register-depth: what of a sequence is used, and how its cameras stand."""
    add = parser.add_argument_group("frames").add_argument
    add("--frames", metavar="START:STOP:STEP", default=":", help="frame numbers to use (default: all)")
    add("--size", metavar="WxH", help="resize images to this size (default: as they are)")
    add("--up", metavar="X,Y,Z", type=up_axis, help="the world's upward direction, if not the source's")
    add_colour_camera(parser, may_look, by_default)


def add_colour_camera(
    parser: argparse._ActionsContainer, may_look: bool = False, by_default: str = AS_RECORDED
) -> None:
    """Add --register-depth, for sequences whose depth is not registered to colour.

    may_look: "auto" and "none" are answers too, for programs that can look at the whole sequence first. by_default says
    in the help what the program does where nothing is asked for, which is None.
    """
    parser.add_argument(
        "--register-depth",
        metavar=f"{LOOK}|{AS_RECORDED}|{_COLOUR_CAMERA_METAVAR}" if may_look else _COLOUR_CAMERA_METAVAR,
        type=depth_registration if may_look else DepthRegistration.parse,
        help=_COLOUR_CAMERA_HELP + (_LOOK_HELP.format(by_default) if may_look else ""),
    )


def add_detector(parser: argparse.ArgumentParser) -> None:
    """Add --detector, --segmenter, --vocabulary and --resegment: what finds the task's nouns and outlines them."""
    add = parser.add_argument_group("perception").add_argument
    add("--detector", metavar="FILE.onnx", type=Path, help=_DETECTOR_HELP)
    add("--segmenter", metavar="FILE.onnx|yolo|depth", help="a FastSAM model, the detector's masks, or depth and colour")
    add("--vocabulary", metavar="FILE.txt", type=Path, help="Grounding DINO's words (default: vocab.txt beside it)")
    add("--resegment", action="store_true", help="cut boxes out anew on every frame (slower)")


def add_policy(parser: argparse.ArgumentParser, may_look: bool = False) -> None:
    """Add --policy, --disable, --pose-prior and --rasterizer: how the map is made.

    may_look: what is believed of views is measured on the sequence unless it is said, for programs that have it whole.
    """
    add = parser.add_argument_group("mapping").add_argument
    add("--policy", choices=sorted(POLICIES), default="task", help="how to spend the budget (default: task)")
    add("--disable", metavar="A,B", type=names, default=(), help=f"parts of the policy off: {' '.join(ABLATION_FLAGS)}")
    add("--rasterizer", choices=BACKENDS, default="auto", help="what draws and trains the map (default: auto)")
    if may_look:
        add_view_error(parser, LOOK, LOOK, may_look)
    else:
        add_view_error(parser)


def add_view_error(
    parser: argparse.ArgumentParser,
    default: PoseExposurePrior | str | None = _TRUSTED,
    shown: str = TRUSTED,
    may_look: bool = False,
) -> None:
    """Add --pose-prior, for cameras whose poses and colours cannot be trusted to the pixel; shown tells the default."""
    parser.add_argument(
        "--pose-prior",
        metavar=f"{LOOK}|{TRUSTED}|{_VIEW_ERROR_METAVAR}" if may_look else f"{TRUSTED}|{_VIEW_ERROR_METAVAR}",
        type=pose_prior if may_look else known_view_error,
        default=default,
        help=_VIEW_ERROR_HELP.format(_MEASURE_HELP if may_look else "", shown),
    )


def add_budget(parser: argparse.ArgumentParser) -> None:
    """Add --max-gaussians, --iterations or --rate with what gives way for it, --seed and --threads: the map's cost."""
    group = parser.add_argument_group("budget")
    add = group.add_argument
    add("--max-gaussians", metavar="N", type=int, default=DEFAULT_MAX_GAUSSIANS, help="hard cap (default: %(default)s)")
    per_frame = group.add_mutually_exclusive_group()
    per_frame.add_argument("--iterations", metavar="N", type=int, help="iterations a frame (default: 8)")
    per_frame.add_argument("--rate", metavar="HZ", type=float, help="frames a second: as many iterations as fit")
    pace = SchedulerSettings()
    least = pace.min_iterations
    add("--min-iterations", metavar="N", type=int, default=least, help="at --rate, iterations to find time for (default: 15)")
    add("--skip-stages", metavar="A,B", type=skip_stages, default=pace.skip_stages, help=_RELIEF_HELP)
    add("--deadline-slack", metavar="SHARE", type=float, default=pace.deadline_slack, help=_RUN_OVER_HELP)
    add("--seed", metavar="S", type=int, default=0, help="seed of every random choice (default: 0)")
    add("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")


def add_voxel_size(parser: argparse.ArgumentParser) -> None:
    """Add --voxel-size, in metres."""
    size_m = VoxelGrid().size_m
    parser.add_argument(
        "--voxel-size", metavar="M", type=float, default=size_m, help="metres of the vote's voxels (default: 0.1)"
    )


def perception_settings(options: argparse.Namespace) -> PerceptionSettings:
    """What add_detector and add_budget asked for: at a rate detections run beside, on one thread."""
    return PerceptionSettings(
        options.detector,
        options.resegment,
        options.threads if options.rate is None else 1,
        asynchronous=options.rate is not None,
        segmenter=options.segmenter,
        vocabulary=options.vocabulary,
    )


def mission_settings(options: argparse.Namespace) -> MissionSettings:
    """What add_policy and add_budget asked for; views to be looked at are trusted so far. Raises InvalidInputError."""
    return MissionSettings(
        policy=options.policy,
        disabled=frozenset(options.disable),
        max_gaussians=options.max_gaussians,
        iterations=options.iterations,
        rate_hz=options.rate,
        min_iterations=options.min_iterations,
        skip_stages=options.skip_stages,
        deadline_slack=options.deadline_slack,
        seed=options.seed,
        threads=options.threads,
        backend=options.rasterizer,
        pose_prior=options.pose_prior if isinstance(options.pose_prior, PoseExposurePrior) else _TRUSTED,
    )


def names(text: str) -> tuple[str, ...]:
    """Split "a,b"."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def skip_stages(text: str) -> tuple[SkippableStage, ...]:
    """Read "publishing,seeding"; argparse reports what is wrong."""
    try:
        return tuple(dict.fromkeys(SkippableStage(name) for name in names(text)))
    except ValueError:
        known = ", ".join(SkippableStage)
        raise argparse.ArgumentTypeError(f"expected names among {known}, got {text!r}") from None


def up_axis(text: str) -> UpAxis:
    """Read "x,y,z"; argparse reports what is wrong."""
    x, y, z = numbers(text, 3)
    return (x, y, z)


def depth_registration(text: str) -> DepthRegistration | str:
    """Read LOOK, AS_RECORDED or a camera. Raises InvalidInputError."""
    return text if text in (LOOK, AS_RECORDED) else DepthRegistration.parse(text)


def pose_prior(text: str) -> PoseExposurePrior | str:
    """Read LOOK, or what known_view_error does. Raises InvalidInputError."""
    return text if text == LOOK else known_view_error(text)


def known_view_error(text: str) -> PoseExposurePrior:
    """Read TRUSTED or numbers. Raises InvalidInputError."""
    return _TRUSTED if text == TRUSTED else PoseExposurePrior.parse(text)


def numbers(text: str, count: int) -> list[float]:
    """Read exactly `count` finite numbers between commas; argparse reports what is wrong."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) < float("inf") for value in values):
        raise argparse.ArgumentTypeError(f"expected {count} finite numbers separated by commas, got {text!r}")
    return values
