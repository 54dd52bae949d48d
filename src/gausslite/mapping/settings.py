"""Settings of a mapping policy, in sections that follow Sec. III-C and III-D; each section is validated once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.render.rasterizer import AdamSettings, LossWeights

ONLINE_RATES = AdamSettings(
    means=6e-4, log_scales=4e-2, quats=8e-3, opacity_logits=5e-2, rgb=2e-2, decay_after_updates=150
)
"""Learning rates for Gaussians with a few dozen iterations: 8 times those of 3DGS for shape and colour, 6 times for
means. With those of 3DGS, small seeds do not grow enough to blend. They decay from the 150th update of a Gaussian on:
with constant rates, Gaussians oscillate between views, and more iterations make a region worse (bench/results).
"""
BALANCED_LOSS = LossWeights(normalise_by_image=True)
_COUNTS = ("first_frame_seeds", "later_seeds", "every", "window", "buffer", "half_size_from_px", "max_pixels")
_INTERVALS = ("active_views", "densify_every", "prune_every", "max_gaussians")
_SEED_SHARES = ("roi_share", "min_alpha", "roi_min_alpha", "min_density_ratio", "background_share")
_SHARES = (*_SEED_SHARES, "roi_context_weight", "max_released", "pose_anchor_share")
_SIZES = ("roi_pixels_per_gaussian", "depth_error_factor", "max_depth_m", "roi_scale", "background_scale", "init_scale")
_BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys((*_COUNTS, *_INTERVALS), (1.0, math.inf)),
    **dict.fromkeys(_SHARES, (0.0, 1.0)),
    **dict.fromkeys(_SIZES, (1e-9, math.inf)),
    "opacity": (1e-6, 1.0 - 1e-6),
    "ema_updates": (0.0, 1e9),
    "saturated": (-math.inf, math.inf),
}
"""Bounds of the numbers below; those of others are 0 and infinity."""


class _Section:
    """Settings whose numbers are within their bounds. Raises InvalidInputError with the name of one that is not."""

    __slots__ = ()

    def __post_init__(self) -> None:
        section: Any = self
        for name in (setting.name for setting in fields(section)):
            value, (low, high) = getattr(self, name), _BOUNDS.get(name, (0.0, math.inf))
            if isinstance(value, int | float) and not low <= value <= high:
                place = type(self).__name__.removesuffix("Settings").lower()
                raise InvalidInputError(f"{place} {name}: expected {low:g} to {high:g}, got {value}")


@dataclass(frozen=True, slots=True)
class Components:
    """The five components of the paper (Sec. III-C, III-D), each of which can be disabled."""

    sb: bool = True
    """ROI seed budgeting (SB): reserve a share of the seeds for the ROI."""
    mvo: bool = True
    """Multi-view optimisation (MVO): train on views drawn from a window of keyframes, not only on the current one."""
    roi: bool = True
    """ROI optimisation (ROI): after a short warm-up, train on the ROI only."""
    sis: bool = True
    """Stratified initial scaling (SIS): one background seed per grid cell, and small initial scales."""
    gfd: bool = True
    """Gradient-focused densification (GFD): draw seeds by image gradient."""

    @property
    def follow_task(self) -> bool:
        """False if the map does not depend on the task."""
        return self.sb or self.roi or self.sis or self.gfd


@dataclass(frozen=True, slots=True)
class SeedingSettings(_Section):
    """Placement and initialisation of new Gaussians (Sec. III-C)."""

    first_frame_seeds: int = 60_000  # N for the first image of 640x480; scaled with the number of pixels
    later_seeds: int = 10_000  # N for each later one
    roi_share: float = 0.40  # ρ of SB (Sec. III-C.1): largest share of the seeds that goes to the ROI
    min_alpha: float = 0.6  # background pixels of lower rendered alpha are seeded: the map does not explain them
    roi_min_alpha: float = 0.9  # the same for ROI pixels; higher, because the region should have no holes
    roi_pixels_per_gaussian: float = 4.0  # ROI pixels per active Gaussian, below which the ROI is dense enough
    fill_sparse_roi: bool = True  # seed ROI pixels with fewer active Gaussians too
    min_density_ratio: float = 0.1  # lowest density of background seeds relative to a first frame's
    background_share: float = 0.3  # of the cap, which ROI seeds leave to the background; they become sparser near it
    depth_error_factor: float = 40.0  # pixels rendered behind the measured depth by so many median errors are seeded
    max_depth_m: float = 10.0  # no seeds beyond: a single outlier would enlarge the whole scene
    opacity: float = 0.5  # α₀ of Sec. III-C.2
    roi_scale: float = 0.5  # m of Eq. (1) for seeds of the ROI
    background_scale: float = 0.7  # m of Eq. (1) for seeds of the background
    init_scale: float = 1.0  # m without SIS
    # also seed blocks without a measured depth (`with_filled_depth`): their colours distort the Gaussians around
    fill_depth: bool = True


@dataclass(frozen=True, slots=True)
class KeyframeSettings(_Section):
    """Keyframes to train on (Sec. III-D.2) and to keep for joint refinement (Sec. III-E)."""

    every: int = 5  # every `every`th mapped frame is a keyframe
    window: int = 24  # most recent keyframes to train on
    buffer: int = 96  # keyframes of the whole mission to keep
    long_term_keyframes: int = 24  # more frames that show the ROI, and as many others; 0 is the paper's window
    # of other pixels in the ROI's tiles, to keep them in place; 0: the paper's mask
    roi_context_weight: float = 0.3
    pose_updates_per_frame: int = 2  # keyframes refined again with each frame, if the pose prior allows an error
    depth_edge_px: int = 2  # depth this near to a depth jump is not trained: sensors err there; 0 as the paper
    rotates: bool = True  # views train in turn (`ViewRotation`); False draws them uniformly, as the paper
    # from this size on, an iteration on whole images trains four of them in half size, with the pixels of one;
    # inf trains one in full size, as the paper
    half_size_from_px: float = 150_000
    max_pixels: int = 160_000_000  # of all keyframes, reached with images above 1280x720; a pixel needs 13 to 20 bytes

    def for_image_size(self, pixels: int) -> KeyframeSettings:
        """Return these settings with as many keyframes as max_pixels allows, at least one of each kind."""
        share = min(1.0, self.max_pixels / (pixels * (self.window + 2 * self.long_term_keyframes + self.buffer)))
        return replace(
            self,
            window=max(1, int(share * self.window)),
            buffer=max(1, int(share * self.buffer)),
            long_term_keyframes=min(self.long_term_keyframes, max(1, int(share * self.long_term_keyframes))),
        )


@dataclass(frozen=True, slots=True)
class OptimizationSettings(_Section):
    """Training with one frame (Sec. III-D): warm-up iterations on full images, then active ones in the ROI."""

    warmup_iterations: int = 2  # on whole images; they keep the background in place
    active_iterations: int = 6  # in the region's tiles
    # trained in turn by an active iteration, if their tiles are no more than one image; 1 as the paper
    active_views: int = 8
    # an active iteration renders and updates active Gaussians alone (Sec. III-D.1): cheaper, but no background occludes
    # the ROI's border; its loss is masked to the ROI in any case
    active_only: bool = False
    # Eq. (2), divided by the image's pixels: Adam's steps with small masks stay comparable
    loss: LossWeights = BALANCED_LOSS
    adam: AdamSettings = ONLINE_RATES  # learning rates
    isotropic: bool = False  # make Gaussians spheres after every frame
    # time constant of the average of a Gaussian that is shown and saved; 0 shows the trained values
    ema_updates: float = 32.0

    @property
    def iterations(self) -> int:
        """Iterations per frame."""
        return self.warmup_iterations + self.active_iterations

    def with_iterations(self, iterations: int) -> OptimizationSettings:
        """Return these settings with this many iterations per frame, in the same ratio of the two phases.

        Of two or more iterations, at least one is a warm-up.
        """
        if iterations < 0:
            raise InvalidInputError(f"optimization iterations: expected at least 0, got {iterations}")
        warmup = round(iterations * self.warmup_iterations / max(self.iterations, 1))
        if self.warmup_iterations > 0:
            warmup = max(warmup, min(1, iterations // 2))
        return replace(self, warmup_iterations=warmup, active_iterations=iterations - warmup)


@dataclass(frozen=True, slots=True)
class SaturationSettings(_Section):
    """Release of active iterations to whole images, by the mean decrease of the log loss per visit of a view.

    Between `improving` and `saturated`, the share of the released iterations is linear.
    """

    max_released: float = 0.75  # largest share that is released; the rest keeps measuring the region. 0 releases none
    improving: float = 0.12  # from this decrease upwards, no iteration is released
    saturated: float = 0.04  # from this one downwards, max_released

    def __post_init__(self) -> None:
        _Section.__post_init__(self)  # no super(): slots make another class
        if not -math.inf < self.saturated < self.improving:
            raise InvalidInputError(f"saturation saturated: expected less than {self.improving}, got {self.saturated}")


@dataclass(frozen=True, slots=True)
class DensitySettings(_Section):
    """Settings of density control, as in 3DGS."""

    densify_every: int = 150  # mapping iterations
    min_mean_gradient: float = 2e-4  # in half image widths, as in the rasterizer's statistics
    percent_dense: float = 0.01  # Gaussians up to this fraction of the scene's extent are cloned, larger ones split
    # of one densification: at low resolution, where all gradients are large, it would fill the table
    max_growth: float = 0.05
    prune_every: int = 100  # mapping iterations
    min_opacity: float = 0.005  # Gaussians below are pruned


@dataclass(frozen=True, slots=True)
class MapperSettings(_Section):
    """A mapping policy."""

    max_gaussians: int = 1_000_000  # hard cap; memory for exactly this number is allocated at the start
    components: Components = field(default_factory=Components)
    seeding: SeedingSettings = field(default_factory=SeedingSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    optimization: OptimizationSettings = field(default_factory=OptimizationSettings)
    saturation: SaturationSettings = field(default_factory=SaturationSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    pose_prior: PoseExposurePrior = field(
        default_factory=PoseExposurePrior
    )  # of the error of each view; refined unless exact
    # of the mission's mean correction, by which each refined pose moves back; 0 without odometry
    pose_anchor_share: float = 0.1
    leaves_out_moving: bool = True  # pixels of things that move are neither seeded nor trained
