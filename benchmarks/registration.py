#!/usr/bin/env python3
"""What registering depth to colour is worth: map all but every eighth frame, score those, print one line.

    benchmarks/registration.py SOURCE --register-depth TEXT [--masks TEXT] [--objects mug_1,mug_2] [--policy uniform]

ROI pixels come from the source seen through --masks, so that several settings are scored on the same pixels.
"""

from __future__ import annotations

import argparse
import sys

from gausslite.config.options import add_budget, add_frames, names
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.errors import GaussLiteError
from gausslite.evaluation.compare import average, score_view
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.evaluation.views import HeldOutView, MapViewer
from gausslite.mapping.policies import POLICIES, TASK
from gausslite.mission.build import build_mapper
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.fixed_relevance import NoTaskEstimator, RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer

HOLD_OUT = 8


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="SOURCE")
    parser.add_argument("--objects", metavar="A,B", type=names, default=(), help="regions of the task (default: all)")
    parser.add_argument("--policy", choices=sorted(POLICIES), default=TASK)
    parser.add_argument(
        "--masks", metavar="TEXT", type=DepthRegistration.parse, help="colour camera behind the ROI masks"
    )
    add_frames(parser)
    add_budget(parser)
    options = parser.parse_args()
    try:
        print(measure(options))
    except GaussLiteError as error:
        print(f"registration: {error}", file=sys.stderr)
        return 2
    return 0


def measure(options: argparse.Namespace) -> str:
    """One line: settings, ROI and full PSNR with SSIM, Gaussians."""
    source = open_source(options.source, options.up, options.register_depth)
    masks = open_source(options.source, options.up, options.masks or options.register_depth)
    size, regions = frame_size(options.size, source), choose_regions(source.regions(), options.objects)
    train, held_out = HeldOutSplit(HOLD_OUT).split(select_frames(source, options.frames))
    settings = MissionSettings(
        options.policy,
        max_gaussians=options.max_gaussians,
        iterations=options.iterations,
        seed=options.seed,
        threads=options.threads,
    )
    attention = RegionRelevanceEstimator(regions) if options.policy == TASK else NoTaskEstimator()
    mapper = TaskMapper(attention, build_mapper(settings))
    for position in train:
        mapper.process(source.frame(position, size))
    viewer = MapViewer(mapper.gaussians(), choose_rasterizer(threads=options.threads))
    scores = []
    for position in held_out:
        view = HeldOutView(source.frame(position, size), HeldOutView.of(masks.frame(position, size), regions).roi)
        scores.append(score_view(viewer.render_frame(view.frame), view))
    result = average(scores)
    roi = "none" if result.roi_psnr is None else f"{result.roi_psnr:.2f} dB ({result.roi_ssim:.3f})"
    return (
        f"{options.policy} {','.join(options.objects)} seed {options.seed} camera {options.register_depth}: ROI {roi}, "
        f"full {result.full_psnr:.2f} dB ({result.full_ssim:.3f}), {len(mapper.gaussians())} Gaussians"
    )


if __name__ == "__main__":
    sys.exit(main())
