"""`gausslite bench camera`: map quality with shutter, blur and lens, corrected or not, against an ideal camera."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import prepare_folder, write_json
from gausslite.mission.settings import MissionSettings
from gausslite_bench.camera_study import CameraCondition, CameraScore, CameraStudy, camera_table, read_truth
from gausslite_bench.cli.argument_types import read_counts, read_image_size
from gausslite_bench.quality.home_tasks import choose_home_tasks

_TASK = "home-1-search"
_SPEEDS = (30, 60, 100)
_LENS = "radtan:-0.2,0.03,0,0"
_MAX_SPEED_DEG_S = 1000


def configure_camera(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench camera`."""
    add = parser.add_argument
    add("--out", metavar="DIR", type=Path, required=True, help="folder for camera.md and camera.json")
    add("--pair", metavar="NAME", default=_TASK, help="home and task such as home-3-search (default: %(default)s)")
    add(
        "--speeds",
        metavar="DEG,...",
        type=read_counts,
        default=_SPEEDS,
        help=f"mean angular speeds in degrees a second (default: {','.join(map(str, _SPEEDS))})",
    )
    add("--shutter", metavar="MS", type=float, default=30.0, help="readout time in ms (default: %(default)g)")
    add("--blur", metavar="MS", type=float, default=10.0, help="exposure time in ms (default: %(default)g)")
    add("--lens", metavar="none|MODEL:K1,...", default=_LENS, help="distortion (default: %(default)s)")
    add("--frames", metavar="N", type=int, default=24, help="mapped frames (default: %(default)s)")
    add("--views", metavar="N", type=int, default=12, help="held-out views (default: %(default)s)")
    add("--size", metavar="WxH", type=read_image_size, default=(320, 240), help="image size (default: 320x240)")
    add("--policy", metavar="NAME", default="task", help="mapping policy (default: %(default)s)")
    add("--max-gaussians", metavar="N", type=int, default=60_000, help="hard cap (default: %(default)s)")
    add("--iterations", metavar="N", type=int, default=8, help="iterations per frame (default: %(default)s)")
    add("--seed", metavar="S", type=int, default=0, help="seed of all random numbers (default: 0)")
    add("--threads", metavar="N", type=int, help="threads (default: all available cores)")
    parser.set_defaults(run=run_camera)


def run_camera(options: argparse.Namespace) -> int:
    """Run the study and rewrite the files after each speed, so that an interrupt loses one speed at most."""
    if not all(1 <= speed <= _MAX_SPEED_DEG_S for speed in options.speeds):
        raise InvalidInputError(f"speeds: expected 1 to {_MAX_SPEED_DEG_S} degrees a second, got {options.speeds}")
    tasks = choose_home_tasks([options.pair])
    if len(tasks) != 1:
        raise InvalidInputError(f"pair: expected one task such as {_TASK}, got {options.pair}")
    settings = MissionSettings(
        policy=options.policy,
        max_gaussians=options.max_gaussians,
        iterations=options.iterations,
        seed=options.seed,
        threads=options.threads,
    )
    truth = read_truth(options.shutter, options.blur, options.lens)
    study = CameraStudy(tasks[0], truth, settings, options.frames, views=options.views, size=options.size)
    prepare_folder(options.out)
    scores: list[CameraScore] = []
    with progress_bar(len(options.speeds) * len(CameraCondition), "camera", "map") as bar:

        def show(score: CameraScore) -> None:
            roi = "no view shows the region" if score.roi_psnr is None else f"ROI {score.roi_psnr:.2f} dB"
            line = f"{score.speed_deg_s} deg/s {score.condition}: {roi}, full {score.full_psnr:.2f} dB"
            print_above_bar("; ".join((line, *score.evidence)))
            bar.update()

        for speed in options.speeds:
            scores += study.run(speed, show)
            _write(options.out, scores)
    print(camera_table(scores))
    print(f"→ {options.out / 'camera.md'}")
    return 0


def _write(folder: Path, scores: Sequence[CameraScore]) -> None:
    command = shlex.join(["gausslite", *sys.argv[1:]])
    write_atomic(folder / "camera.md", f"# bench camera\n\n`{command}`\n\n{camera_table(scores)}".encode())
    write_json(folder / "camera.json", {"command": command, "scores": [score.as_json() for score in scores]})
