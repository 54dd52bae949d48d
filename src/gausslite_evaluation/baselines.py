"""Mapping policies of published systems, to compare with: `--policy gaussian-slam`, `splatam` and `monogs`.

A baseline follows no task; seeding, scales, loss weights and density control are those of its system's released
configuration. Everything else is common to all policies: Adam's rates (ONLINE_RATES), the density limit of seeds near
the cap, seeds where no depth is measured, clone and split that preserve appearance, pose refinement, and the views to
train on, in turn. With so few iterations, the released rates would lose several decibels. Views are the 24 most recent
keyframes and 24 others, spread over the mission; the task policy also has 24 that show the ROI. Two values were tuned
in the baselines' favour (bench/results): the initial scale of MonoGS and the number of SplaTAM's seeds.
"""

from __future__ import annotations

import math
from typing import Final

from gausslite.mapping.policies import NO_TASK
from gausslite.mapping.settings import DensitySettings, MapperSettings, OptimizationSettings, SeedingSettings
from gausslite.render.rasterizer import LossWeights

_NO_DENSIFICATION: Final = DensitySettings(min_mean_gradient=math.inf)

GAUSSIAN_SLAM: Final = MapperSettings(
    components=NO_TASK,
    optimization=OptimizationSettings(warmup_iterations=7, active_iterations=0),
    density=_NO_DENSIFICATION,
)
"""Gaussian-SLAM (Yugay et al. 2023).

Uniform seeds where alpha < 0.6, scale = neighbour distance, 7 iterations, prune only.
"""

SPLATAM: Final = MapperSettings(
    components=NO_TASK,
    seeding=SeedingSettings(
        first_frame_seeds=76_800, later_seeds=8_000, min_alpha=0.5, depth_error_factor=50.0, init_scale=0.5
    ),
    optimization=OptimizationSettings(loss=LossWeights(colour=0.4, depth=1.0, ssim=0.1), isotropic=True),
    density=_NO_DENSIFICATION,
)
"""SplaTAM (Keetha et al. 2024).

Isotropic Gaussians of one pixel's width: every fourth pixel of the first frame, then at most 2000 per frame of 320x240,
where alpha < 0.5 or depth errs by 50 times its median; no clone, no split.
"""

MONOGS: Final = MapperSettings(
    components=NO_TASK,
    seeding=SeedingSettings(first_frame_seeds=9_600, later_seeds=4_800, min_alpha=1.0, init_scale=math.sqrt(0.05)),
    optimization=OptimizationSettings(loss=LossWeights(colour=0.95, depth=0.05, ssim=0.0)),
)
"""MonoGS with RGB-D input (Matsuki et al. 2024).

Small sparse seeds everywhere (one pixel in 32, later in 64; point size 0.05 scales the squared neighbour distance), no
SSIM term, clone and split by gradient.
"""
