"""Everything about mapping that can be chosen, in small sections, each checked once when it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.errors import InvalidInputError
from gausslite.mapping.task_change import TaskChangeSettings
from gausslite.optimize.density import DensitySettings
from gausslite.optimize.rates import ONLINE_RATES
from gausslite.render.rasterizer import AdamSettings, LossWeights


@dataclass(frozen=True, slots=True)
class Components:
    """The paper's five components (Sec. III-C, III-D), each with its own switch."""

    sb: bool = True
    """ROI seed budgeting: a share of the seeds is reserved for the task's region."""
    mvo: bool = True
    """Multi-view optimisation: train on views drawn from a window of keyframes, not on the current one alone."""
    roi: bool = True
    """ROI optimisation: after a short warm-up, train on the task's region only."""
    sis: bool = True
    """Stratified initial scaling: one background seed a cell, and seeds that start small."""
    gfd: bool = True
    """Gradient-focused densification: seeds prefer image edges."""

    @property
    def follow_task(self) -> bool:
        """False where none of them asks for the task's region: the map is the same for every task."""
        return self.sb or self.roi or self.sis or self.gfd


class ActivePhase(StrEnum):
    """What an active-phase iteration draws and moves; its loss is masked to the region in every case."""

    EXACT = "exact"
    """Draw every Gaussian in the region's tiles; all of them may move."""
    FROZEN_BACKGROUND = "frozen-background"
    """Draw every Gaussian in the region's tiles; only active ones move."""
    ACTIVE_ONLY = "active-only"
    """Draw active Gaussians only: cheaper, but nothing hides the missing background at the region's borders."""


@dataclass(frozen=True, slots=True)
class SeedingSettings:
    """Where new Gaussians go and how they start (Sec. III-C). Seed counts are for 640x480 and scale with the pixels.

    roi_scale and background_scale are the paper's multipliers m of s0; init_scale is m without SIS.
    background_share: what the region's seeds leave of the cap to the background, however large the region is.
    """

    first_frame_seeds: int = 60_000
    later_seeds: int = 10_000
    roi_share: float = 0.40
    min_alpha: float = 0.6
    roi_min_alpha: float = 0.9
    roi_pixels_per_gaussian: float = 4.0
    reserved_views: float = 4.0
    min_density_ratio: float = 0.1
    background_share: float = 0.3
    depth_error_factor: float = 40.0
    max_depth_m: float = 10.0
    opacity: float = 0.5
    roi_scale: float = 0.5
    background_scale: float = 0.7
    init_scale: float = 1.0
    edge_epsilon: float = 0.01

    def __post_init__(self) -> None:
        for name in ("first_frame_seeds", "later_seeds"):
            _require(getattr(self, name) >= 1, f"seeding {name}", "at least 1", getattr(self, name))
        for name in ("roi_share", "min_alpha", "roi_min_alpha", "min_density_ratio", "background_share"):
            _require(0 <= getattr(self, name) <= 1, f"seeding {name}", "0 to 1", getattr(self, name))
        _require(0 < self.opacity < 1, "seeding opacity", "more than 0 and less than 1", self.opacity)
        for name in (
            "roi_pixels_per_gaussian",
            "reserved_views",
            "depth_error_factor",
            "max_depth_m",
            "roi_scale",
            "background_scale",
            "init_scale",
            "edge_epsilon",
        ):
            _require(getattr(self, name) > 0, f"seeding {name}", "more than 0", getattr(self, name))


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Which frames are kept to train on: every `every`th, the `window` latest of them, and `buffer` of the mission.

    long_term_keyframes: of all frames that show the task's region (of all frames, where no component follows a task) so many
    more stay ready to train on, spread over the mission; 0 is the paper's window. Each takes as much memory as a frame
    of the window.
    roi_context_weight, 0 to 1: what pixels beside the region count in the active phase's loss, in the tiles that it
    draws anyway; 0 is the paper's binary mask, which lets what stands beside the region move as it likes.
    pose_updates_per_frame: where views may be wrong (`MapperSettings.pose_prior`) so many of those ready to train on are fitted to the
    map again with each frame, in turns.
    max_pixels: of larger images than 1280x720 or so fewer are kept, so that all of them have no more pixels than this;
    a pixel takes about 13 bytes, 20 where its view may be wrong.
    """

    every: int = 5
    window: int = 24
    buffer: int = 96
    long_term_keyframes: int = 24
    roi_margin_px: int = 5
    roi_context_weight: float = 0.3
    pose_updates_per_frame: int = 2
    max_pixels: int = 160_000_000

    def __post_init__(self) -> None:
        for name in ("every", "window", "buffer", "max_pixels"):
            _require(getattr(self, name) >= 1, f"keyframes {name}", "at least 1", getattr(self, name))
        for name in ("long_term_keyframes", "roi_margin_px", "pose_updates_per_frame"):
            _require(getattr(self, name) >= 0, f"keyframes {name}", "at least 0", getattr(self, name))
        weight = self.roi_context_weight
        _require(0 <= weight <= 1, "keyframes roi_context_weight", "0 to 1", weight)

    def for_image_size(self, pixels: int) -> KeyframeSettings:
        """The same with as many images of this size as have room: one of each kind, however large they are."""
        share = min(1.0, self.max_pixels / (pixels * (self.window + self.long_term_keyframes + self.buffer)))
        return replace(
            self,
            window=max(1, int(share * self.window)),
            buffer=max(1, int(share * self.buffer)),
            long_term_keyframes=min(self.long_term_keyframes, max(1, int(share * self.long_term_keyframes))),
        )


_ALIKE_IN_BOTH_PHASES = LossWeights(normalise_by_image=True)


@dataclass(frozen=True, slots=True)
class OptimizationSettings:
    """How a frame trains the map (Sec. III-D): first warm-up iterations on the full image, then active ones.

    loss: by share, so that warm-ups and the active phase, whose masks are small, do not undo each other in Adam.
    isotropic: Gaussians are made spheres again after every frame.
    decay_after_updates: where views may be wrong (`MapperSettings.pose_prior`) a Gaussian has the full rates for so many
    updates, and falling ones after them (`AdamSettings.decay_after_updates`): steps of one size would keep it moving to
    and fro between what its views say. inf never slows it.
    ema_updates: the map is shown as the mean of each Gaussian over about its last so many updates, since views
    that contradict each other move it to and fro; 0 shows it as training left it. Training itself knows no means.
    """

    warmup_iterations: int = 2
    active_iterations: int = 6
    active_phase: ActivePhase = ActivePhase.EXACT
    loss: LossWeights = _ALIKE_IN_BOTH_PHASES
    adam: AdamSettings = ONLINE_RATES
    decay_after_updates: float = 150.0
    isotropic: bool = False
    ema_updates: float = 32.0

    def __post_init__(self) -> None:
        for name in ("warmup_iterations", "active_iterations"):
            _require(getattr(self, name) >= 0, f"optimization {name}", "at least 0", getattr(self, name))
        averaged = self.ema_updates
        _require(0 <= averaged < math.inf, "optimization ema_updates", "at least 0", averaged)
        _require(self.decay_after_updates > 0, "optimization decay_after_updates", "more than 0", self.decay_after_updates)

    @property
    def iterations(self) -> int:
        """Iterations a frame."""
        return self.warmup_iterations + self.active_iterations

    def with_iterations(self, iterations: int) -> OptimizationSettings:
        """The same proportion of the two phases in this many iterations a frame, and of two at least one a warm-up."""
        _require(iterations >= 0, "optimization iterations", "at least 0", iterations)
        warmup = round(iterations * self.warmup_iterations / max(self.iterations, 1))
        if self.warmup_iterations > 0:
            warmup = max(warmup, min(1, iterations // 2))
        return replace(self, warmup_iterations=warmup, active_iterations=iterations - warmup)


@dataclass(frozen=True, slots=True)
class MapperSettings:
    """A whole mapping policy. max_gaussians is a hard cap: memory for exactly that many is reserved at the start.

    pose_prior: how wrong poses and colours of frames may be; keyframes are refined where it is not 0.
    """

    max_gaussians: int = 1_000_000
    components: Components = field(default_factory=Components)
    seeding: SeedingSettings = field(default_factory=SeedingSettings)
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    optimization: OptimizationSettings = field(default_factory=OptimizationSettings)
    density: DensitySettings = field(default_factory=DensitySettings)
    task_change: TaskChangeSettings = field(default_factory=TaskChangeSettings)
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)

    def __post_init__(self) -> None:
        _require(self.max_gaussians >= 1, "max_gaussians", "at least 1", self.max_gaussians)

    @property
    def adam(self) -> AdamSettings:
        """The optimiser's rates, for views that are trusted or not."""
        if self.pose_prior.is_exact:
            return self.optimization.adam
        return replace(self.optimization.adam, decay_after_updates=self.optimization.decay_after_updates)


def _require(holds: bool, name: str, wanted: str, came: float) -> None:
    if not holds:
        raise InvalidInputError(f"{name}: expected {wanted}, got {came}")
