"""Options of the quality studies, and the scenes that they select."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gausslite.cli.source_options import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    stated_values,
)
from gausslite.config.plain_values import split_names
from gausslite.config.program import add_flags
from gausslite.config.values import NONE, PRIOR_FORM, read_prior, read_up_axis
from gausslite.datasets.regions import REGIONS_FILE
from gausslite.datasets.source import downscaled_size
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.settings import POSE_PRIOR_HELP
from gausslite_bench.cli.argument_types import read_image_size, read_seeds
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import HomeTask, choose_home_tasks
from gausslite_bench.quality.real_scenes import REAL_CAMERA, RealScenePlan, choose_kinds, real_plans
from gausslite_bench.quality.scenes import PosePolicy, ScenePlan
from gausslite_evaluation.lpips import LPIPS_HELP

_HOME_FRAMES = 60
_HOME_SIZE = (320, 240)


def add_study_options(parser: argparse.ArgumentParser, default_seeds: tuple[int, ...]) -> None:
    """Add the output folder, the seeds, the frames and their poses, and the options of a real sequence."""
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, required=True, help="folder for tables, sheets and cached trials")
    parser.add_argument(
        "--reuse-other-code",
        action="store_true",
        help="also reuse cached trials from other code (default: compute them again)",
    )
    seeds = ",".join(str(seed) for seed in default_seeds)
    add("--seeds", metavar="N,...", type=read_seeds, default=default_seeds, help=f"mapping seeds (default: {seeds})")
    add(
        "--frames",
        metavar="N",
        type=int,
        help=f"training frames (default: {_HOME_FRAMES} per home, all of a real sequence)",
    )
    add("--views", metavar="N", type=int, default=24, help="held-out views per home (default: %(default)s)")
    add(
        "--recorded-size",
        metavar="WxH",
        type=read_image_size,
        help="size of the images that simulated cameras record and detectors see (default: --size, that of the maps)",
    )
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    add("--lpips-weights", metavar="PATH", type=Path, help=LPIPS_HELP)
    add_real_sequence(parser)


def add_real_sequence(parser: argparse.ArgumentParser) -> None:
    """Add the options of a real sequence, and how its pose errors are handled."""
    parser.add_argument(
        "--pose-prior",
        metavar=f"{NONE}|{PRIOR_FORM}",
        type=read_prior,
        help=f"{POSE_PRIOR_HELP} (default: homes none, real {REAL_CAMERA.pose_prior})",
    )
    parser.add_argument(
        "--fit-views",
        action=argparse.BooleanOptionalAction,
        help="also score with each view's pose and exposure fitted (default: real sequences only)",
    )
    group = parser.add_argument_group("real sequence")
    add = group.add_argument
    add("--real", metavar="FOLDER", type=Path, help="measure on this sequence; on homes too if they are named")
    add(
        "--roi",
        metavar="FILE.npz",
        type=Path,
        help=f"its regions; one task per kind of object (default: FOLDER/{REGIONS_FILE})",
    )
    add(
        "--kinds", metavar="A,B", type=split_names, default=(), help="kinds of objects such as mug,chair (default: all)"
    )
    add("--up", metavar="X,Y,Z", type=read_up_axis, help="the world's upward direction (default: the source's)")
    add_flags(group, RecordingOptions, "register-depth", "camera-correction")


def scene_plans(
    options: argparse.Namespace, task_names: Sequence[str], default_names: Sequence[str]
) -> tuple[list[ScenePlan], tuple[int, int]]:
    """Return the scenes and a default image size: home tasks, a real sequence, or both.

    task_names: homes or home-task pairs; default_names replaces an empty list if there is no real sequence. Raises
    InvalidInputError, DatasetError.
    """
    real = real_sequence_plans(options)
    if real is None:
        return [*_home_plans(options, choose_home_tasks(task_names or default_names))], _HOME_SIZE
    plans, size = real
    return [*(_home_plans(options, choose_home_tasks(task_names)) if task_names else ()), *plans], size


def _home_plans(options: argparse.Namespace, tasks: Sequence[HomeTask]) -> list[HomeScenePlan]:
    frames = _HOME_FRAMES if options.frames is None else options.frames
    pose_policy = _pose_policy(options, PosePolicy())
    return [
        HomeScenePlan(task, frames, options.views, pose_policy=pose_policy, recorded_size=options.recorded_size)
        for task in tasks
    ]


def real_sequence_plans(options: argparse.Namespace) -> tuple[list[RealScenePlan], tuple[int, int]] | None:
    """Return the plans of the real sequence and an image size with its aspect ratio; None without --real.

    Raises InvalidInputError, DatasetError.
    """
    if options.real is None:
        for name in ("roi", "kinds"):
            if getattr(options, name):
                raise InvalidInputError(f"--{name}: expected a real sequence, --real FOLDER; got none")
        return None
    roi = options.roi or options.real / REGIONS_FILE
    if options.roi is None and not roi.is_file():
        raise InvalidInputError(
            f"--real: expected a folder and its regions, --real FOLDER --roi FILE.npz; got none, and no {roi}"
        )
    # check the options before the registration is estimated from the images
    plans = real_plans(options.real, roi, options.frames, options.up, pose_policy=_pose_policy(options, REAL_CAMERA))
    chosen = choose_kinds(plans, options.kinds)
    spec = str(options.real)
    stated = stated_values(options.register_depth, options.camera_correction, REAL_CAMERA.pose_prior)
    found = calibrate_with_messages(spec, open_recorded(spec, options.up), stated)
    correction = None if found.correction.is_identity else found.correction
    plans = [replace(plan, depth_registration=found.registration, camera_correction=correction) for plan in chosen]
    return plans, downscaled_size(found.source.camera)


def _pose_policy(options: argparse.Namespace, default: PosePolicy) -> PosePolicy:
    return PosePolicy(
        default.pose_prior if options.pose_prior is None else options.pose_prior,
        default.fit_views if options.fit_views is None else options.fit_views,
    )
