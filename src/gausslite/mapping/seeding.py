"""Seed new Gaussians from pixels of a frame, by relevance to the task (Sec. III-C: SB, SIS, GFD)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.camera import lift
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import transform_points
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.coverage import RenderedView, rendered_behind, undersampled_roi
from gausslite.mapping.sampling import edge_magnitude, sample_pixels, sample_stratified
from gausslite.mapping.settings import Components, SeedingSettings
from gausslite.mapping.spacing import initial_spacing_m, neighbour_distance_px

_REFERENCE_PIXELS = 640 * 480
"""Image size of the seed counts in SeedingSettings."""


@dataclass(frozen=True, slots=True, eq=False)
class SeedingContext:
    """State of the map before seeding.

    free_slots: Gaussians that still fit under the cap. rendered: the map rendered from the frame's pose, None if the
    map is empty. active_means_m: means of the active Gaussians.
    """

    free_slots: int
    rendered: RenderedView | None
    active_means_m: Float32[ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """New Gaussians: N_ROI seeds of the ROI, inserted first, and N_bg of the background (without SB: of any pixel)."""

    roi: Gaussians
    background: Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """Candidate pixels, the number to draw, and whether to draw one per grid cell (SIS)."""

    pixels: Bool[ndarray, "h w"]
    count: int
    stratified: bool


class Seeder:
    """Draws the seeds of each frame with the mapper's random generator."""

    def __init__(self, settings: SeedingSettings, components: Components, rng: np.random.Generator) -> None:
        self._settings = settings
        self._components = components
        self._rng = rng

    def seed(self, frame: Frame, relevance: RelevanceMap, context: SeedingContext) -> Seeds:
        """Return new Gaussians for this frame."""
        pixel_weights = self._pixel_weights(frame)
        roi_pool, background_pool = self._split_budget(frame, relevance, context)
        return Seeds(
            roi=self._draw(frame, relevance, roi_pool, pixel_weights),
            background=self._draw(frame, relevance, background_pool, pixel_weights),
        )

    def seed_roi(self, frame: Frame, relevance: RelevanceMap, active_means_m: Float32[ndarray, "n 3"]) -> Gaussians:
        """Return new Gaussians for ROI pixels of an earlier frame that have too few active ones (after a task change).

        The budget is the ROI share of a first frame; without SB there are none.
        """
        settings = self._settings
        if not self._components.sb:
            return Gaussians.empty()
        sparse = undersampled_roi(frame, relevance.roi, active_means_m, settings.roi_pixels_per_gaussian)
        pixels = sparse & (frame.depth_m <= settings.max_depth_m)
        budget = round(settings.roi_share * settings.first_frame_seeds * pixels.size / _REFERENCE_PIXELS)
        return self._draw(frame, relevance, self._roi_pool(pixels, budget), self._pixel_weights(frame))

    def _split_budget(self, frame: Frame, relevance: RelevanceMap, context: SeedingContext) -> tuple[_Pool, _Pool]:
        """SB (Sec. III-C.1): split N into floor(ρN) ROI seeds and the background's; without SB all are background.

        Only pixels that the map does not explain yet are candidates.
        """
        settings = self._settings
        budget = self._budget(frame, context)
        seedable = (frame.depth_m > 0) & (frame.depth_m <= settings.max_depth_m)
        roi_candidates = candidates = seedable
        if context.rendered is not None:
            behind = rendered_behind(frame, context.rendered, settings.depth_error_factor)
            candidates = seedable & (behind | (context.rendered.alpha < settings.min_alpha))
            roi_candidates = seedable & (behind | (context.rendered.alpha < settings.roi_min_alpha))
        if not self._components.sb:
            no_roi = _Pool(np.zeros_like(seedable), 0, stratified=False)
            return no_roi, self._background_pool(candidates, budget, context.free_slots)
        roi_budget = int(settings.roi_share * budget)
        if settings.fill_sparse_roi:
            sparse = undersampled_roi(frame, relevance.roi, context.active_means_m, settings.roi_pixels_per_gaussian)
            roi_candidates = roi_candidates | (sparse & seedable)
        roi_pool = self._roi_pool(relevance.roi & roi_candidates, roi_budget)
        background_budget = budget - roi_budget
        return roi_pool, self._background_pool(candidates & ~relevance.roi, background_budget, context.free_slots)

    def _roi_pool(self, pixels: Bool[ndarray, "h w"], budget: int) -> _Pool:
        """Limit the ROI seeds to one per `roi_pixels_per_gaussian` pixels. Eviction frees slots for them."""
        max_count = int(np.ceil(np.count_nonzero(pixels) / self._settings.roi_pixels_per_gaussian))
        return _Pool(pixels, min(budget, max_count), stratified=False)

    def _background_pool(self, pixels: Bool[ndarray, "h w"], budget: int, free_slots: int) -> _Pool:
        """Limit the density of seeds so that `reserved_views` more full images would fit under the cap.

        Otherwise the first views would fill the map. With fewer free slots, seeds are sparser and start larger.
        """
        settings = self._settings
        max_density = settings.first_frame_seeds / _REFERENCE_PIXELS
        affordable = free_slots / (settings.reserved_views * pixels.size)
        density = min(max_density, max(affordable, settings.min_density_ratio * max_density))
        count = min(budget, int(np.ceil(density * np.count_nonzero(pixels))))
        return _Pool(pixels, count, stratified=self._components.sis)

    def _budget(self, frame: Frame, context: SeedingContext) -> int:
        """Return N, the seed budget of the frame, for this image size."""
        seeds = self._settings.first_frame_seeds if context.rendered is None else self._settings.later_seeds
        return max(1, round(seeds * frame.depth_m.size / _REFERENCE_PIXELS))

    def _pixel_weights(self, frame: Frame) -> Float32[ndarray, "h w"]:
        """GFD (Sec. III-C.3): return E(u, v) + ε, the sampling weight of each pixel; without GFD it is uniform."""
        if not self._components.gfd:
            return np.ones(frame.depth_m.shape, np.float32)
        edges = edge_magnitude(frame.rgb)
        return edges + np.float32(self._settings.edge_epsilon)

    def _draw(
        self, frame: Frame, relevance: RelevanceMap, pool: _Pool, pixel_weights: Float32[ndarray, "h w"]
    ) -> Gaussians:
        """Draw pixels from the pool and return their Gaussians."""
        sample = sample_stratified if pool.stratified else sample_pixels
        pixels = sample(pool.pixels, pool.count, pixel_weights, self._rng)
        if len(pixels) == 0:
            return Gaussians.empty()
        distance_px = neighbour_distance_px(pixels, pool.pixels, pool.stratified)
        spacing_m = initial_spacing_m(distance_px, frame.depth_m.ravel()[pixels], frame.camera)
        return self._init_gaussians(frame, relevance, pixels, spacing_m)

    def _init_gaussians(
        self, frame: Frame, relevance: RelevanceMap, pixels: Int64[ndarray, " n"], spacing_m: Float32[ndarray, " n"]
    ) -> Gaussians:
        """SIS (Sec. III-C.2): scale s0·m, identity rotation, observed colour, active flag a from w at the seed's pixel.

        spacing_m: s0 in metres.
        """
        settings, count = self._settings, len(pixels)
        active = relevance.roi.ravel()[pixels]
        scale_m = spacing_m * np.float32(settings.init_scale)
        if self._components.sis:
            scale_m = spacing_m * np.where(active, settings.roi_scale, settings.background_scale).astype(np.float32)
        rows, columns = np.divmod(pixels, frame.camera.width_px)
        depths_m = frame.depth_m[rows, columns].astype(np.float64)
        points = lift(np.stack([columns, rows], axis=1) + 0.5, depths_m, frame.camera)
        if frame.motion is not None:
            points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
        return Gaussians(
            means_m=transform_points(frame.T_world_camera, points).astype(np.float32),
            quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            scales_m=np.repeat(scale_m[:, None], 3, axis=1),
            opacities=np.full(count, settings.opacity, np.float32),
            rgb=frame.rgb.reshape(-1, 3)[pixels].astype(np.float32) / np.float32(255.0),
            active=active,
            kappa=np.zeros(count, np.uint32),
            target=relevance.target.ravel()[pixels],
        )
