"""Declare the options of perception and mapping, and convert them to settings and back."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from gausslite.config.numbers import Number
from gausslite.config.presets import PRESETS
from gausslite.config.switches import DependentDefault, add_switch, set_dependent_default
from gausslite.config.toml_text import OptionValue
from gausslite.config.values import AUTO, NONE, read_names, read_pose_prior, read_pose_prior_or_auto, read_skip_stages
from gausslite.domain.motion_model import MotionModel
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.policies import EXTENSION_FLAGS, POLICIES, TASK, policy
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.mission.settings import (
    DEFAULT_MAX_GAUSSIANS,
    MAX_ITERATIONS,
    MAX_RATE_HZ,
    MAX_SEED,
    MIN_RATE_HZ,
    MissionSettings,
    PerceptionSettings,
    PoseMode,
)
from gausslite.perception.detector import DEFAULT_TILES_PER_SIDE, MAX_TILES_PER_SIDE
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.choose import BACKENDS
from gausslite.render.cpu_kernels import MAX_THREADS, choose_threads

HOLD_OUT_HELP = "hold out every N-th selected frame from mapping, for evaluation"
_EXACT = PoseExposurePrior()
_POSE_PRIOR_METAVAR = "M,DEG[,GAIN,OFFSET]"
_POSE_PRIOR_HELP = (
    "standard deviations of the errors of poses (metres, degrees) and of exposure (gain and offset, 0 to 1), within "
    "which views are corrected; none: poses and colours are exact{} (default: {})"
)
_POSES_HELP = (
    "given: map with the given poses; refine: refine them within --pose-prior; track: find poses by tracking the "
    "camera against the map, from the first given pose on (default: %(default)s)"
)
_TRACK_MOTION_HELP = (
    "with --poses track, what predicts the motion between two frames without enough common features: the last velocity "
    "or the given odometry (default: %(default)s)"
)
_AUTO_HELP = "; auto: estimated from pairs of frames"
_DISABLE_HELP = (
    "switch off parts of the policy: sb (ROI seed budgeting; ROI: the task's region of interest), mvo (multi-view "
    "optimisation), roi (ROI optimisation), sis (stratified initial scaling), gfd (gradient-focused densification), "
)
_SKIP_STAGES_HELP = (
    "at --rate, stages that a frame without enough time skips, in this order (default: publishing,seeding)"
)


def add_detector(parser: argparse.ArgumentParser) -> None:
    """Add the options that state how the task's objects are detected and outlined."""
    group = parser.add_argument_group("perception")
    add = group.add_argument
    add(
        "--detector",
        metavar="FILE.onnx",
        type=Path,
        help="a YOLO, YOLO-World or Grounding DINO model (default: the source's ground truth)",
    )
    add(
        "--segmenter",
        metavar="FILE.onnx|yolo|depth",
        help="a FastSAM model, the detector's own masks, or segmentation by depth and colour",
    )
    add(
        "--vocabulary",
        metavar="FILE.txt",
        type=Path,
        help="the text encoder's vocabulary (default: vocab.txt or tokenizer.json in the model's folder)",
    )
    add_switch(group, "--accept-similar", "also map objects of a class that is only similar to the task's noun")
    add(
        "--tiles",
        metavar="N",
        type=Number("tiles", int, 1, MAX_TILES_PER_SIDE),
        default=DEFAULT_TILES_PER_SIDE,
        help="also detect in NxN enlarged parts of each keyframe, as time allows; 1: off (default: %(default)s)",
    )


def add_policy(
    parser: argparse.ArgumentParser, allow_auto: bool = False, default_policy: DependentDefault = lambda _: TASK
) -> None:
    """Add --preset, --policy, --disable, --rasterizer and --pose-prior.

    allow_auto: the pose prior may be, and by default is, estimated; for programs that read the whole sequence first.
    default_policy: returns the policy that the program uses if --policy is not set.
    """
    add = parser.add_argument_group("mapping").add_argument
    preset_help = "set of defaults for other options; paper: the paper's method without additions"
    add("--preset", choices=sorted(PRESETS), help=preset_help)
    chosen = add(
        "--policy",
        choices=sorted(POLICIES),
        help="how the map is seeded and trained (default: task; map without a task: uniform)",
    )
    set_dependent_default(chosen, default_policy)
    extensions = ", ".join(EXTENSION_FLAGS)
    add("--disable", metavar="A,B", type=read_names, default=(), help=f"{_DISABLE_HELP}{extensions}")
    add_rasterizer(add, "backend that renders and trains")
    add_pose_prior(parser, AUTO if allow_auto else NONE, AUTO if allow_auto else NONE, allow_auto)
    add("--poses", choices=[str(mode) for mode in PoseMode], default=str(PoseMode.REFINE), help=_POSES_HELP)
    motions = [str(motion) for motion in MotionModel]
    add("--track-motion", choices=motions, default=str(MotionModel.VELOCITY), help=_TRACK_MOTION_HELP)


def add_rasterizer(add: Callable[..., argparse.Action], meaning: str) -> None:
    """Add --rasterizer with the `add_argument` of a parser or group."""
    add("--rasterizer", choices=BACKENDS, default="auto", help=f"{meaning} (default: %(default)s)")


def add_pose_prior(parser: argparse.ArgumentParser, default: str | None, default_text: str, allow_auto: bool) -> None:
    """Add --pose-prior; default is the default's text, default_text names it in the help."""
    parser.add_argument(
        "--pose-prior",
        metavar=f"{AUTO}|{NONE}|{_POSE_PRIOR_METAVAR}" if allow_auto else f"{NONE}|{_POSE_PRIOR_METAVAR}",
        type=read_pose_prior_or_auto if allow_auto else read_pose_prior,
        default=default,
        help=_POSE_PRIOR_HELP.format(_AUTO_HELP if allow_auto else "", default_text),
    )


def add_budget(parser: argparse.ArgumentParser) -> None:
    """Add the options that limit what a map costs: its size, iterations or frame rate, threads; and the seed."""
    group = parser.add_argument_group("budget")
    add = group.add_argument
    add(
        "--max-gaussians",
        metavar="N",
        type=Number("max-gaussians", int, 1),
        default=DEFAULT_MAX_GAUSSIANS,
        help="upper limit of the map's size (default: %(default)s)",
    )
    per_frame = group.add_mutually_exclusive_group()
    iterations = per_frame.add_argument(
        "--iterations",
        metavar="N",
        type=Number("iterations", int, 0, MAX_ITERATIONS),
        help="iterations per frame (default: 8)",
    )
    set_dependent_default(iterations, _default_iterations)
    per_frame.add_argument(
        "--rate",
        metavar="HZ",
        type=Number("rate", float, MIN_RATE_HZ, MAX_RATE_HZ),
        help="frames per second; each frame trains as long as its time allows",
    )
    scheduler = SchedulerSettings()
    add(
        "--min-iterations",
        metavar="N",
        type=Number("min-iterations", int, 0, MAX_ITERATIONS),
        default=scheduler.min_iterations,
        help="at --rate, iterations that every frame should get (default: %(default)s)",
    )
    add(
        "--skip-stages",
        metavar="A,B",
        type=read_skip_stages,
        default=scheduler.skip_stages,
        help=_SKIP_STAGES_HELP,
    )
    add(
        "--deadline-slack",
        metavar="SHARE",
        type=Number("deadline-slack", float, 0, 1),
        default=scheduler.deadline_slack,
        help="at --rate, share of a frame's time it may overrun for its minimum iterations (default: %(default)s)",
    )
    seed = Number("seed", int, 0, MAX_SEED)
    add("--seed", metavar="S", type=seed, default=0, help="seed of every random choice (default: 0)")
    add_threads(group)


def add_threads(parser: argparse._ActionsContainer) -> None:
    """Add --threads."""
    action = parser.add_argument(
        "--threads",
        metavar="N",
        type=Number("threads", int, 1, MAX_THREADS),
        help="threads (default: all that the processor has)",
    )
    set_dependent_default(action, lambda _: choose_threads(None))


def _default_iterations(options: argparse.Namespace) -> int | None:
    """Return the policy's iterations per frame; None at a rate."""
    if options.rate is not None:
        return None
    settings = policy(getattr(options, "policy", None) or TASK).optimization
    return settings.warmup_iterations + settings.active_iterations


def add_voxel_size(parser: argparse.ArgumentParser) -> None:
    """Add --voxel-size, in metres."""
    parser.add_argument(
        "--voxel-size",
        metavar="M",
        type=Number("voxel-size", float, 1e-3, 1e3),
        default=VoxelGrid().size_m,
        help="edge of the fusion's voxels in metres (default: %(default)s)",
    )


def perception_settings(options: argparse.Namespace) -> PerceptionSettings:
    """Return the settings of `add_detector` and `add_budget`; at a rate, detection is asynchronous, on one thread."""
    return PerceptionSettings(
        options.detector,
        threads=options.threads if options.rate is None else 1,
        asynchronous=options.rate is not None,
        segmenter=options.segmenter,
        vocabulary=options.vocabulary,
        accept_similar=options.accept_similar,
        tiles=options.tiles,
        # the next keyframe comes at the latest after this time
        detection_time_s=None if options.rate is None else RelevanceTrackerSettings().max_frames / options.rate,
    )


def mission_settings(options: argparse.Namespace, default_policy: str = TASK) -> MissionSettings:
    """Return the settings of `add_policy` and `add_budget`; a pose prior of AUTO counts as exact.

    Raises InvalidInputError.
    """
    return MissionSettings(
        policy=options.policy or default_policy,
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
        pose_prior=options.pose_prior if isinstance(options.pose_prior, PoseExposurePrior) else _EXACT,
        poses=PoseMode(options.poses),
        motion=MotionModel(options.track_motion),
    )


def perception_options(settings: PerceptionSettings) -> dict[str, OptionValue]:
    """Return the option values from which `perception_settings` makes these settings, with absolute paths."""
    return {
        "detector": None if settings.model is None else str(settings.model.absolute()),
        "segmenter": settings.segmenter,
        "vocabulary": None if settings.vocabulary is None else str(settings.vocabulary.absolute()),
        "accept-similar": settings.accept_similar,
        "tiles": settings.tiles,
    }


def mission_options(settings: MissionSettings) -> dict[str, OptionValue]:
    """Return the option values from which `mission_settings` makes these settings."""
    return {
        "policy": settings.policy,
        "disable": ",".join(sorted(settings.disabled)),
        "max-gaussians": settings.max_gaussians,
        "iterations": settings.iterations,
        "rate": settings.rate_hz,
        "min-iterations": settings.min_iterations,
        "skip-stages": ",".join(settings.skip_stages),
        "deadline-slack": settings.deadline_slack,
        "seed": settings.seed,
        "threads": settings.threads,
        "rasterizer": settings.backend,
        "pose-prior": NONE if settings.pose_prior.is_exact else str(settings.pose_prior),
        "poses": str(settings.poses),
        "track-motion": str(settings.motion),
    }
