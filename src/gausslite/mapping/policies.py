"""Named mapping policies (task, paper, uniform and those of packages), and the flags that disable their parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.settings import (
    Components,
    DensitySettings,
    KeyframeSettings,
    MapperSettings,
    OptimizationSettings,
    SeedingSettings,
)
from gausslite.plugins import Group, load, names
from gausslite.render.rasterizer import AdamSettings, LossWeights

NO_TASK = Components(sb=False, mvo=True, roi=False, sis=False, gfd=False)
TASK = "task"
"""Name of the default policy."""
UNIFORM = "uniform"
"""Name of the policy without a region of interest."""
_PARTS: dict[str, tuple[str, float | bool]] = {
    **{name: (f"components.{name}", False) for name in ("sb", "mvo", "roi", "sis", "gfd")},
    "long-term-keyframes": ("keyframes.long_term_keyframes", 0),
    "roi-context": ("keyframes.roi_context_weight", 0.0),
    "depth-edge-mask": ("keyframes.depth_edge_px", 0),
    "depth-fill": ("seeding.fill_depth", False),
    "background-reserve": ("seeding.background_share", 0.0),
    "ema": ("optimization.ema_updates", 0.0),
    "lr-decay": ("optimization.adam.decay_after_updates", math.inf),
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
        optimization=OptimizationSettings(active_only=True, loss=LossWeights(), adam=AdamSettings()),
        density=DensitySettings(max_growth=1.0),
    )
    return disable(published, EXTENSION_FLAGS)


_CORE: dict[str, Callable[[], MapperSettings]] = {
    TASK: MapperSettings,  # the paper's five components and the extensions of EXTENSION_FLAGS
    "paper": paper_policy,
    UNIFORM: lambda: MapperSettings(components=NO_TASK),  # seeds and trains whole images, with the same density control
}
POLICIES = (*_CORE, *names(Group.POLICIES))
"""All names; those of packages are the baselines of comparisons."""


def policy(name: str) -> MapperSettings:
    """Return the settings of a named policy. Raises InvalidInputError for another name, MissingPluginError."""
    if name not in POLICIES:
        raise InvalidInputError(f"policy: expected one of {', '.join(POLICIES)}, got {name!r}")
    settings: MapperSettings = _CORE[name]() if name in _CORE else load(Group.POLICIES, name)
    return settings


def disable(settings: MapperSettings, names: Collection[str]) -> MapperSettings:
    """Return these settings with the named parts disabled. Raises InvalidInputError if a name is unknown."""
    unknown = sorted(set(names) - set(ABLATION_FLAGS))
    if unknown:
        raise InvalidInputError(f"disable: expected names among {', '.join(ABLATION_FLAGS)}, got {', '.join(unknown)}")
    for name in names:
        settings = _with_field(settings, *_PARTS[name])
    return settings


def _with_field(settings: Any, path: str, value: Any) -> Any:
    """Return the settings with another value of "field", or of "section.field" and so on."""
    name, _, rest = path.partition(".")
    return replace(settings, **{name: _with_field(getattr(settings, name), rest, value) if rest else value})
