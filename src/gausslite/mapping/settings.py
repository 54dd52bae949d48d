"""Settings of a mapping policy, in sections that follow Sec. III-C and III-D; each section is validated once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.render.rasterizer import AdamSettings, LossWeights

ONLINE_RATES = AdamSettings(
    means=6e-4, log_scales=4e-2, quats=8e-3, opacity_logits=5e-2, rgb=2e-2, decay_after_updates=150
)
"""Learning rates for Gaussians with a few dozen iterations. Those of shape and colour are 8 times the 3DGS rates,
those of the means 6 times. With the 3DGS rates small seeds do not grow enough to blend. On a real kitchen
(320x240, 8 iterations per frame) these rates gain 1.7 dB in the region of interest, and as much for uniform
mapping. Means that move 6 times instead of twice as fast gain 0.2 dB in the region and 0.5 dB over the whole image.

They decay from the 150th update of a Gaussian on: with constant rates, Gaussians oscillate between views, and more
iterations make a region worse. A decay from the 50th update on loses 0.3 dB over the whole images of a HoloLens
recording at 32 iterations per frame.
"""

"""The same rates, those of the means twice the 3DGS rate, with decay from the 20th update of a Gaussian on. A joint
refinement ends, and its last large steps would remain as noise. Over the 3DGS rates, 500 iterations gain 0.2 dB in the
region and 1.0 dB over the whole image of the simulated home. The decay gains 0.9 dB in the region (fitted views) on a
real kitchen with the frames of two robots, and 0.2 dB on simulated homes.
"""
BALANCED_LOSS = LossWeights(normalise_by_image=True)


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


class ActivePhase(StrEnum):
    """Which Gaussians the iterations of the active phase render and update; their loss is always masked to the ROI."""

    ALL_GAUSSIANS = "all-gaussians"
    """Render and update all Gaussians in the ROI's tiles, active or not."""
    FROZEN_BACKGROUND = "frozen-background"
    """Render all Gaussians in the ROI's tiles, but update only the active ones."""
    ACTIVE_ONLY = "active-only"
    """Render and update active Gaussians only (Sec. III-D.1): cheaper, but no background occludes the ROI's border."""


@dataclass(frozen=True, slots=True)
class SeedingSettings:
    """Placement and initialisation of new Gaussians (Sec. III-C).

    first_frame_seeds, later_seeds: N for an image of 640x480, scaled with the number of pixels. roi_share: ρ.
    min_alpha, roi_min_alpha: background and ROI pixels of lower rendered alpha are seeded. depth_error_factor: pixels
    rendered behind the measured depth by this multiple of the median depth error are seeded. roi_pixels_per_gaussian:
    ROI pixels per active Gaussian, below which the ROI is dense enough. fill_sparse_roi: seed ROI pixels with fewer
    active Gaussians too. min_density_ratio: lowest density of background seeds relative to a first frame's.
    background_share: share of the cap that ROI seeds leave to the background; they become sparser as the region fills
    the rest. opacity, roi_scale, background_scale: opacity and the multipliers m of s0 (Sec. III-C.2); init_scale: m
    without SIS. fill_depth: blocks without a measured depth are seeded too, at `with_filled_depth`. Sensors have none
    on dark, glossy or distant surfaces and at the border of registered images; without seeds, the colours there distort
    the Gaussians around.
    """

    first_frame_seeds: int = 60_000
    later_seeds: int = 10_000
    roi_share: float = 0.40
    min_alpha: float = 0.6
    roi_min_alpha: float = 0.9
    roi_pixels_per_gaussian: float = 4.0
    fill_sparse_roi: bool = True
    min_density_ratio: float = 0.1
    background_share: float = 0.3
    depth_error_factor: float = 40.0
    max_depth_m: float = 10.0
    opacity: float = 0.5
    roi_scale: float = 0.5
    background_scale: float = 0.7
    init_scale: float = 1.0
    fill_depth: bool = True

    def __post_init__(self) -> None:
        for name in ("first_frame_seeds", "later_seeds"):
            _require(getattr(self, name) >= 1, f"seeding {name}", "at least 1", getattr(self, name))
        for name in ("roi_share", "min_alpha", "roi_min_alpha", "min_density_ratio", "background_share"):
            _require(0 <= getattr(self, name) <= 1, f"seeding {name}", "0 to 1", getattr(self, name))
        _require(0 < self.opacity < 1, "seeding opacity", "more than 0 and less than 1", self.opacity)
        for name in (
            "roi_pixels_per_gaussian",
            "depth_error_factor",
            "max_depth_m",
            "roi_scale",
            "background_scale",
            "init_scale",
        ):
            _require(getattr(self, name) > 0, f"seeding {name}", "more than 0", getattr(self, name))


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Keyframes to train on (Sec. III-D.2) and to keep for joint refinement (Sec. III-E).

    every: every `every`th mapped frame is a keyframe. window: most recent keyframes to train on. buffer: keyframes of
    the whole mission to keep. long_term_keyframes: more frames to train on, spread over the mission: this number that
    show the ROI and as many others; 0 is the paper's window. Each needs as much memory as a keyframe of the window.
    roi_context_weight: weight in the active phase's loss of pixels outside the ROI but inside its tiles, 0 to 1; 0 is
    the paper's binary mask. pose_updates_per_frame: keyframes whose pose and exposure are refined again with each frame
    if `MapperSettings.pose_prior` allows an error. depth_edge_px: depth within this distance of a depth jump is not
    trained; 0 trains all depth, as the paper. rotates: views train in turn (`ViewRotation`); False draws them
    uniformly, as the paper. half_size_from_px: an iteration on whole images of at least this many pixels trains four of
    them in half size, with the pixels of one; inf trains one in full size, as the paper. max_pixels: cap on the pixels
    of all keyframes together, reached with images larger than about 1280x720; a pixel needs 13 bytes, or 20 with
    refined poses.
    """

    every: int = 5
    window: int = 24
    buffer: int = 96
    long_term_keyframes: int = 24
    roi_context_weight: float = 0.3
    pose_updates_per_frame: int = 2
    depth_edge_px: int = 2
    rotates: bool = True
    half_size_from_px: float = 150_000
    max_pixels: int = 160_000_000

    def __post_init__(self) -> None:
        for name in ("every", "window", "buffer", "half_size_from_px", "max_pixels"):
            _require(getattr(self, name) >= 1, f"keyframes {name}", "at least 1", getattr(self, name))
        for name in ("long_term_keyframes", "pose_updates_per_frame", "depth_edge_px"):
            _require(getattr(self, name) >= 0, f"keyframes {name}", "at least 0", getattr(self, name))
        weight = self.roi_context_weight
        _require(0 <= weight <= 1, "keyframes roi_context_weight", "0 to 1", weight)

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
class OptimizationSettings:
    """Training of the map with one frame (Sec. III-D): warm-up iterations on full images, then active ones on the ROI.

    active_views: views that an active iteration trains in turn, if the tiles of their regions are together no more than
    one image; 1 is the paper's. loss: weights of Eq. (2). By default they are normalised by the image size. Adam's
    steps with the small masks of the active phase are then comparable to those with full images. adam: learning rates.
    isotropic: make Gaussians spheres after every frame. ema_updates: time constant, in updates,
    of the exponential moving average (EMA) of each Gaussian. The EMA is shown and saved, but not trained; 0 shows the
    trained values.
    """

    warmup_iterations: int = 2
    active_iterations: int = 6
    active_views: int = 8
    active_phase: ActivePhase = ActivePhase.ALL_GAUSSIANS
    loss: LossWeights = BALANCED_LOSS
    adam: AdamSettings = ONLINE_RATES
    isotropic: bool = False
    ema_updates: float = 32.0

    def __post_init__(self) -> None:
        for name in ("warmup_iterations", "active_iterations"):
            _require(getattr(self, name) >= 0, f"optimization {name}", "at least 0", getattr(self, name))
        _require(self.active_views >= 1, "optimization active_views", "at least 1", self.active_views)
        updates = self.ema_updates
        _require(0 <= updates < math.inf, "optimization ema_updates", "at least 0", updates)

    @property
    def iterations(self) -> int:
        """Iterations per frame."""
        return self.warmup_iterations + self.active_iterations

    def with_iterations(self, iterations: int) -> OptimizationSettings:
        """Return these settings with this many iterations per frame, in the same ratio of the two phases.

        Of two or more iterations, at least one is a warm-up.
        """
        _require(iterations >= 0, "optimization iterations", "at least 0", iterations)
        warmup = round(iterations * self.warmup_iterations / max(self.iterations, 1))
        if self.warmup_iterations > 0:
            warmup = max(warmup, min(1, iterations // 2))
        return replace(self, warmup_iterations=warmup, active_iterations=iterations - warmup)


@dataclass(frozen=True, slots=True)
class SaturationSettings:
    """Release of active iterations to whole images.

    max_released: largest share of the active iterations that is released; 0 disables the release. The rest keeps
    measuring the region. improving, saturated: mean decreases of the log loss per visit of a view. No iteration is
    released from `improving` upwards, and max_released from `saturated` downwards. Between them the share is linear.
    """

    max_released: float = 0.75
    improving: float = 0.12
    saturated: float = 0.04

    def __post_init__(self) -> None:
        if not 0 <= self.max_released <= 1:
            raise InvalidInputError(f"saturation max_released: expected 0 to 1, got {self.max_released}")
        if not -math.inf < self.saturated < self.improving < math.inf:
            raise InvalidInputError(
                f"saturation saturated: expected less than improving ({self.improving}), got {self.saturated}"
            )


@dataclass(frozen=True, slots=True)
class DensitySettings:
    """Settings of density control.

    densify_every, prune_every: in mapping iterations. min_mean_gradient: in half image widths, as in the rasterizer's
    statistics. percent_dense: Gaussians up to this fraction of the scene's extent are cloned, larger ones split.
    max_growth: bound of one densification, as a fraction of the number of Gaussians. At low resolution, where all
    gradients are large, the threshold alone would fill the table and leave no free slots for seeds.
    """

    densify_every: int = 150
    min_mean_gradient: float = 2e-4
    percent_dense: float = 0.01
    max_growth: float = 0.05
    prune_every: int = 100
    min_opacity: float = 0.005

    def __post_init__(self) -> None:
        for name in ("densify_every", "prune_every"):
            _require(getattr(self, name) >= 1, f"density {name}", "at least 1 iteration", getattr(self, name))
        for name in ("min_mean_gradient", "percent_dense", "max_growth", "min_opacity"):
            _require(getattr(self, name) >= 0, f"density {name}", "at least 0", getattr(self, name))


@dataclass(frozen=True, slots=True)
class MapperSettings:
    """A mapping policy.

    max_gaussians: hard cap; memory for exactly this number is allocated at the start. pose_prior: prior of the pose and
    exposure error of each view; keyframes are refined unless it is exact. pose_anchor_share: share of the mission's
    mean pose correction by which each refined pose moves back towards the odometry; 0 for poses without odometry.
    leaves_out_moving: pixels of things that move are neither seeded nor trained.
    """

    max_gaussians: int = 1_000_000
    components: Components = field(default_factory=Components)
    seeding: SeedingSettings = field(default_factory=SeedingSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    optimization: OptimizationSettings = field(default_factory=OptimizationSettings)
    saturation: SaturationSettings = field(default_factory=SaturationSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)
    pose_anchor_share: float = 0.1
    leaves_out_moving: bool = True

    def __post_init__(self) -> None:
        _require(self.max_gaussians >= 1, "max_gaussians", "at least 1", self.max_gaussians)
        share = self.pose_anchor_share
        _require(0 <= share <= 1, "pose_anchor_share", "0 to 1", share)


def _require(valid: bool, name: str, expected: str, value: float) -> None:
    if not valid:
        raise InvalidInputError(f"{name}: expected {expected}, got {value}")
