"""Named mapping policies (task, paper, uniform and the baselines), and the flags that disable their parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.baselines import gaussian_slam_policy, monogs_policy, splatam_policy, uniform_policy
from gausslite.mapping.saturation import SaturationSettings
from gausslite.mapping.settings import (
    ActivePhase,
    KeyframeSettings,
    MapperSettings,
    OptimizationSettings,
    SeedingSettings,
)
from gausslite.optimize.density import DensitySettings
from gausslite.render.rasterizer import AdamSettings, LossWeights


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
    Poses are an external input (III-C): combine this policy with an exact `MapperSettings.pose_prior`, the default.
    """
    return MapperSettings(
        seeding=SeedingSettings(
            roi_min_alpha=0.6,
            roi_pixels_per_gaussian=1.0,
            fill_sparse_roi=False,
            min_density_ratio=1.0,
            background_share=0.0,
        ),
        keyframes=KeyframeSettings(
            long_term_keyframes=0, roi_context_weight=0.0, pose_updates_per_frame=0, depth_edge_px=0
        ),
        optimization=OptimizationSettings(
            active_phase=ActivePhase.ACTIVE_ONLY,
            loss=LossWeights(),
            adam=AdamSettings(),
            decay_after_updates=math.inf,
            ema_updates=0.0,
        ),
        saturation=SaturationSettings(max_released=0.0),
        density=DensitySettings(max_growth=1.0),
    )


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


PAPER_FLAGS = ("sb", "mvo", "roi", "sis", "gfd")
"""The paper's components (Sec. III-C, III-D), in the order of its ablation (Table III)."""


def _without_long_term_keyframes(settings: MapperSettings) -> MapperSettings:
    return replace(settings, keyframes=replace(settings.keyframes, long_term_keyframes=0))


def _without_roi_context(settings: MapperSettings) -> MapperSettings:
    return replace(settings, keyframes=replace(settings.keyframes, roi_context_weight=0.0))


def _without_depth_edge_mask(settings: MapperSettings) -> MapperSettings:
    return replace(settings, keyframes=replace(settings.keyframes, depth_edge_px=0))


def _without_background_reserve(settings: MapperSettings) -> MapperSettings:
    return replace(settings, seeding=replace(settings.seeding, background_share=0.0))


def _without_ema(settings: MapperSettings) -> MapperSettings:
    return replace(settings, optimization=replace(settings.optimization, ema_updates=0.0))


def _without_lr_decay(settings: MapperSettings) -> MapperSettings:
    return replace(settings, optimization=replace(settings.optimization, decay_after_updates=math.inf))


def _without_saturation(settings: MapperSettings) -> MapperSettings:
    return replace(settings, saturation=replace(settings.saturation, max_released=0.0))


EXTENSION_FLAGS: dict[str, Callable[[MapperSettings], MapperSettings]] = {
    "long-term-keyframes": _without_long_term_keyframes,
    "roi-context": _without_roi_context,
    "depth-edge-mask": _without_depth_edge_mask,
    "background-reserve": _without_background_reserve,
    "ema": _without_ema,
    "lr-decay": _without_lr_decay,
    "saturation": _without_saturation,
}
"""Extensions of the paper's method that can be disabled, in the order of the ablation in bench/results."""

ABLATION_FLAGS = (*PAPER_FLAGS, *EXTENSION_FLAGS)
"""All names that `disable` accepts."""


def disable(settings: MapperSettings, names: Collection[str]) -> MapperSettings:
    """Return these settings with the named parts disabled. Raises InvalidInputError if a name is unknown."""
    unknown = sorted(set(names) - set(ABLATION_FLAGS))
    if unknown:
        raise InvalidInputError(f"disable: expected names among {', '.join(ABLATION_FLAGS)}, got {', '.join(unknown)}")
    off = dict.fromkeys((name for name in PAPER_FLAGS if name in names), False)
    settings = replace(settings, components=replace(settings.components, **off))
    for name in (each for each in EXTENSION_FLAGS if each in names):
        settings = EXTENSION_FLAGS[name](settings)
    return settings
