"""The mappers others compare with, as settings of this engine: same cap, same poses, as many views.

Each seeds, scales, weighs its loss and controls density as its released configuration does. What those leave to the
hardware is the engine's: Adam's rates (ONLINE_RATES: the customary ones trail by decibels in so few iterations),
seeds thinned as the cap nears, clones and halves that look like their parent, refined views where they are asked for,
and the views to train on: the 24 latest keyframes and, where the task policy has 24 frames that show its region, 24 of
any, spread over the mission as well. The scale of MonoGS' seeds and the number of SplaTAM's were varied
(docs/quality.md). None of them knows a task.
"""

from __future__ import annotations

import math

from gausslite.mapping.settings import Components, MapperSettings, OptimizationSettings, SeedingSettings
from gausslite.optimize.density import DensitySettings
from gausslite.render.rasterizer import LossWeights

_NO_TASK = Components(sb=False, mvo=True, roi=False, sis=False, gfd=False)
_NEVER = math.inf


def uniform_policy() -> MapperSettings:
    """Uniform seeds and full-image training, with this engine's own density control."""
    return MapperSettings(components=_NO_TASK)


def gaussian_slam_policy() -> MapperSettings:
    """Yugay et al. 2023: uniform seeds where alpha < 0.6, scale = neighbour distance, 7 iterations, prune alone."""
    return MapperSettings(
        components=_NO_TASK,
        optimization=OptimizationSettings(warmup_iterations=7, active_iterations=0),
        density=DensitySettings(min_mean_gradient=_NEVER),
    )


def splatam_policy() -> MapperSettings:
    """Keetha et al. 2024: spheres of a pixel's width, every fourth pixel of the first frame, then at most 2000 a frame
    of 320x240 where alpha < 0.5 or depth errs by 50 times its median; no clone, no split.
    """
    return MapperSettings(
        components=_NO_TASK,
        seeding=SeedingSettings(
            first_frame_seeds=76_800, later_seeds=8_000, min_alpha=0.5, depth_error_factor=50.0, init_scale=0.5
        ),
        optimization=OptimizationSettings(loss=LossWeights(colour=0.4, depth=1.0, ssim=0.1), isotropic=True),
        density=DensitySettings(min_mean_gradient=_NEVER),
    )


def monogs_policy() -> MapperSettings:
    """Matsuki et al. 2024, RGB-D: sparse small seeds everywhere (one pixel in 32, later in 64; point size 0.05 shrinks
    the squared neighbour distance), no SSIM, clone and split where the gradient asks.
    """
    return MapperSettings(
        components=_NO_TASK,
        seeding=SeedingSettings(first_frame_seeds=9_600, later_seeds=4_800, min_alpha=1.0, init_scale=math.sqrt(0.05)),
        optimization=OptimizationSettings(loss=LossWeights(colour=0.95, depth=0.05, ssim=0.0)),
    )
