"""Named mapping policies (task, paper, uniform and the baselines), and the flags that disable their parts.

A baseline follows no task; seeding, scales, loss weights and density control are those of its system's released
configuration. Everything else is common to all policies: Adam's rates (ONLINE_RATES), the density limit of seeds near
the cap, seeds where no depth is measured, clone and split that preserve appearance, pose refinement, and the views to
train on, in turn. With so few iterations, the released rates would lose several decibels. Views are the 24 most recent
keyframes and 24 others, spread over the mission; the task policy also has 24 that show the ROI. Two values were tuned
in the baselines' favour (bench/results): the initial scale of MonoGS and the number of SplaTAM's seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.settings import (
    ActivePhase,
    Components,
    DensitySettings,
    KeyframeSettings,
    MapperSettings,
    OptimizationSettings,
    SeedingSettings,
)
from gausslite.render.rasterizer import AdamSettings, LossWeights

_NO_TASK = Components(sb=False, mvo=True, roi=False, sis=False, gfd=False)
_NO_DENSIFICATION = DensitySettings(min_mean_gradient=math.inf)


def uniform_policy() -> MapperSettings:
    """Return uniform seeding and full-image training with this engine's density control."""
    return MapperSettings(components=_NO_TASK)


def gaussian_slam_policy() -> MapperSettings:
    """Return Gaussian-SLAM (Yugay et al. 2023).

    Uniform seeds where alpha < 0.6, scale = neighbour distance, 7 iterations, prune only.
    """
    return MapperSettings(
        components=_NO_TASK,
        optimization=OptimizationSettings(warmup_iterations=7, active_iterations=0),
        density=_NO_DENSIFICATION,
    )


def splatam_policy() -> MapperSettings:
    """Return SplaTAM (Keetha et al. 2024).

    Isotropic Gaussians of one pixel's width: every fourth pixel of the first frame, then at most 2000 per frame of
    320x240, where alpha < 0.5 or depth errs by 50 times its median; no clone, no split.
    """
    return MapperSettings(
        components=_NO_TASK,
        seeding=SeedingSettings(
            first_frame_seeds=76_800, later_seeds=8_000, min_alpha=0.5, depth_error_factor=50.0, init_scale=0.5
        ),
        optimization=OptimizationSettings(loss=LossWeights(colour=0.4, depth=1.0, ssim=0.1), isotropic=True),
        density=_NO_DENSIFICATION,
    )


def monogs_policy() -> MapperSettings:
    """Return MonoGS with RGB-D input (Matsuki et al. 2024).

    Small sparse seeds everywhere (one pixel in 32, later in 64; point size 0.05 scales the squared neighbour distance),
    no SSIM term, clone and split by gradient.
    """
    return MapperSettings(
        components=_NO_TASK,
        seeding=SeedingSettings(first_frame_seeds=9_600, later_seeds=4_800, min_alpha=1.0, init_scale=math.sqrt(0.05)),
        optimization=OptimizationSettings(loss=LossWeights(colour=0.95, depth=0.05, ssim=0.0)),
    )


def task_policy() -> MapperSettings:
    """Return the default policy: the paper's five components and the extensions of EXTENSION_FLAGS."""
    return MapperSettings()


def paper_policy() -> MapperSettings:
    """Return the method as published. Where the paper gives no value, Gaussian-SLAM's or SplaTAM's release does.

    Seeding (III-C): N seeds per frame (60 000, later 10 000, at 640x480), ρ = 0.40, where rendered alpha < 0.6 or
    depth errs by 40 times its median; no density limit for ROI or background seeds, no reserve for the background.
    SIS (III-C.2): opacity 0.5, m = 0.5 in the ROI and 0.7 in the background. GFD (III-C.3): weights E + ε.
    ROI (III-D.1): 2 warm-up and 6 active iterations; the active phase renders and updates active Gaussians only, with
    a binary mask, and the loss is divided by the mask's pixels.
    MVO (III-D.2): every 5th frame is a keyframe and the 24 most recent ones train the map; Adam with Gaussian-SLAM's
    constant learning rates; standard clone, split and prune without a growth limit; the map is shown as trained.
    The scene is static: pixels of things that move are used like all others.
    Poses are an external input (III-C): combine this policy with an exact `MapperSettings.pose_prior`, the default.
    """
    published = MapperSettings(
        seeding=SeedingSettings(
            roi_min_alpha=0.6, roi_pixels_per_gaussian=1.0, fill_sparse_roi=False, min_density_ratio=1.0
        ),
        keyframes=KeyframeSettings(pose_updates_per_frame=0),
        optimization=OptimizationSettings(
            active_phase=ActivePhase.ACTIVE_ONLY, loss=LossWeights(), adam=AdamSettings()
        ),
        density=DensitySettings(max_growth=1.0),
    )
    return disable(published, EXTENSION_FLAGS)


TASK = "task"
"""Name of the default policy."""
UNIFORM = "uniform"
"""Name of the policy without a region of interest."""

POLICIES: dict[str, Callable[[], MapperSettings]] = {
    TASK: task_policy,
    "paper": paper_policy,
    UNIFORM: uniform_policy,
    "gaussian-slam": gaussian_slam_policy,
    "splatam": splatam_policy,
    "monogs": monogs_policy,
}


def policy(name: str) -> MapperSettings:
    """Return the settings of a named policy. Raises InvalidInputError if the name is not in POLICIES."""
    if name not in POLICIES:
        raise InvalidInputError(f"policy: expected one of {', '.join(POLICIES)}, got {name!r}")
    return POLICIES[name]()


def follows_task(name: str) -> bool:
    """True if the map of a named policy depends on the task. Raises InvalidInputError."""
    return policy(name).components.follow_task


_PARTS: dict[str, tuple[str, float | bool]] = {
    **{name: (f"components.{name}", False) for name in ("sb", "mvo", "roi", "sis", "gfd")},
    "long-term-keyframes": ("keyframes.long_term_keyframes", 0),
    "roi-context": ("keyframes.roi_context_weight", 0.0),
    "depth-edge-mask": ("keyframes.depth_edge_px", 0),
    "depth-fill": ("seeding.fill_depth", False),
    "background-reserve": ("seeding.background_share", 0.0),
    "ema": ("optimization.ema_updates", 0.0),
    "lr-decay": ("optimization.decay_after_updates", math.inf),
    "saturation": ("saturation.max_released", 0.0),
    "motion-mask": ("leaves_out_moving", False),
    "view-rotation": ("keyframes.rotates", False),
    "active-views": ("optimization.active_views", 1),
    "half-size": ("keyframes.half_size_from_px", math.inf),
}
"""The field of `MapperSettings` that each part of the task policy has, and the field's value without the part."""

ABLATION_FLAGS = tuple(_PARTS)
"""All names that `disable` accepts, in the order of the ablation in bench/results."""
PAPER_FLAGS, EXTENSION_FLAGS = ABLATION_FLAGS[:5], ABLATION_FLAGS[5:]
"""The paper's components (Sec. III-C, III-D) in the order of its ablation (Table III), and the extensions."""


def disable(settings: MapperSettings, names: Collection[str]) -> MapperSettings:
    """Return these settings with the named parts disabled. Raises InvalidInputError if a name is unknown."""
    unknown = sorted(set(names) - set(ABLATION_FLAGS))
    if unknown:
        raise InvalidInputError(f"disable: expected names among {', '.join(ABLATION_FLAGS)}, got {', '.join(unknown)}")
    for name in names:
        settings = _with_field(settings, *_PARTS[name])
    return settings


def _with_field(settings: MapperSettings, path: str, value: Any) -> MapperSettings:
    """Return the settings with another value of "field" or of "section.field"."""
    section, _, name = path.rpartition(".")
    if section:
        name, value = section, replace(getattr(settings, section), **{name: value})
    return replace(settings, **{name: value})
