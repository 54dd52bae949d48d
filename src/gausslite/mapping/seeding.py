"""Turn pixels of a frame into new Gaussians, more and finer ones where the task is (Sec. III-C: SB, SIS, GFD)."""

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


@dataclass(frozen=True, slots=True, eq=False)
class SeedingContext:
    """What seeding needs to know of the map: how many Gaussians still fit, how it looks from the frame (None while it
    is empty), and where its active Gaussians are.
    """

    free_slots: int
    rendered: RenderedView | None
    active_means_m: Float32[ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """New Gaussians: those of the ROI budget, served first when room is short, and the rest."""

    roi: Gaussians
    rest: Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """Pixels to draw from, how many, and how."""

    pixels: Bool[ndarray, "h w"]
    count: int
    stratified: bool


class Seeder:
    """Draws each frame's seeds; its random generator is the mapper's."""

    def __init__(self, settings: SeedingSettings, components: Components, rng: np.random.Generator) -> None:
        self._settings = settings
        self._components = components
        self._rng = rng

    def seed(self, frame: Frame, relevance: RelevanceMap, context: SeedingContext) -> Seeds:
        """New Gaussians for this frame."""
        weight = self._pixel_weight(frame)
        roi_pool, rest_pool = self._pools(frame, relevance, context)
        return Seeds(
            roi=self._gaussians(frame, relevance, roi_pool, weight),
            rest=self._gaussians(frame, relevance, rest_pool, weight),
        )

    def seed_roi(self, frame: Frame, relevance: RelevanceMap, active_means_m: Float32[ndarray, "n 3"]) -> Gaussians:
        """New Gaussians where the map is too coarse for the region in an earlier frame; as many as a first frame gets.

        What surrounds the region was seeded when the frame was mapped.
        """
        settings = self._settings
        if not self._components.sb:
            return Gaussians.empty()
        coarse = undersampled_roi(frame, relevance.roi, active_means_m, settings.roi_pixels_per_gaussian)
        pixels = coarse & (frame.depth_m <= settings.max_depth_m)
        budget = round(settings.roi_share * settings.first_frame_seeds * pixels.size / _REFERENCE_PIXELS)
        return self._gaussians(frame, relevance, self._roi_pool(pixels, budget), self._pixel_weight(frame))

    def _pools(self, frame: Frame, relevance: RelevanceMap, context: SeedingContext) -> tuple[_Pool, _Pool]:
        """SB: the ROI share of the seeds is drawn from the region, the rest elsewhere; without SB from one pool."""
        settings = self._settings
        budget = self._budget(frame, context)
        seedable = (frame.depth_m > 0) & (frame.depth_m <= settings.max_depth_m)
        roi_open = open_pixels = seedable
        if context.rendered is not None:
            behind = rendered_behind(frame, context.rendered, settings.depth_error_factor)
            open_pixels = seedable & (behind | (context.rendered.alpha < settings.min_alpha))
            roi_open = seedable & (behind | (context.rendered.alpha < settings.roi_min_alpha))
        if not self._components.sb:
            return _Pool(np.zeros_like(seedable), 0, False), self._rest_pool(open_pixels, budget, context.free_slots)
        roi_budget = int(settings.roi_share * budget)
        coarse = undersampled_roi(frame, relevance.roi, context.active_means_m, settings.roi_pixels_per_gaussian)
        roi_pixels = relevance.roi & (roi_open | (coarse & seedable))
        rest_pixels = open_pixels & ~relevance.roi
        return self._roi_pool(roi_pixels, roi_budget), self._rest_pool(rest_pixels, budget - roi_budget, context.free_slots)

    def _roi_pool(self, pixels: Bool[ndarray, "h w"], budget: int) -> _Pool:
        """No denser than the active Gaussians that the region is to have; its room is made by others."""
        wanted = int(np.ceil(np.count_nonzero(pixels) / self._settings.roi_pixels_per_gaussian))
        return _Pool(pixels, min(budget, wanted), False)

    def _rest_pool(self, pixels: Bool[ndarray, "h w"], budget: int, room: int) -> _Pool:
        """No denser than leaves room for `reserved_views` more views as open as this whole image would be.

        So the first views do not use up the cap: as room gets short, seeds get sparser and start larger.
        """
        settings = self._settings
        densest = settings.first_frame_seeds / _REFERENCE_PIXELS
        affordable = room / (settings.reserved_views * pixels.size)
        density = min(densest, max(affordable, settings.min_density_ratio * densest))
        return _Pool(pixels, min(budget, int(np.ceil(density * np.count_nonzero(pixels)))), self._components.sis)

    def _budget(self, frame: Frame, context: SeedingContext) -> int:
        """N, for this image size."""
        seeds = self._settings.first_frame_seeds if context.rendered is None else self._settings.later_seeds
        return max(1, round(seeds * frame.depth_m.size / _REFERENCE_PIXELS))

    def _pixel_weight(self, frame: Frame) -> Float32[ndarray, "h w"]:
        """GFD: P ∝ E + ε; without it uniform."""
        if not self._components.gfd:
            return np.ones(frame.depth_m.shape, np.float32)
        edges = edge_magnitude(frame.rgb)
        return edges + np.float32(self._settings.edge_epsilon)

    def _gaussians(
        self, frame: Frame, relevance: RelevanceMap, pool: _Pool, weight: Float32[ndarray, "h w"]
    ) -> Gaussians:
        sample = sample_stratified if pool.stratified else sample_pixels
        pixels = sample(pool.pixels, pool.count, weight, self._rng)
        if len(pixels) == 0:
            return Gaussians.empty()
        distance_px = neighbour_distance_px(pixels, pool.pixels, pool.stratified)
        spacing_m = initial_spacing_m(distance_px, frame.depth_m.ravel()[pixels], frame.camera.fx_px)
        return self._born(frame, relevance, pixels, spacing_m)

    def _born(
        self, frame: Frame, relevance: RelevanceMap, pixels: Int64[ndarray, " n"], spacing_m: Float32[ndarray, " n"]
    ) -> Gaussians:
        """SIS: scale s0·m, identity rotation, observed colour, and the active flag of the seed's pixel."""
        settings, count = self._settings, len(pixels)
        active = relevance.roi.ravel()[pixels]
        scale_m = spacing_m * np.float32(settings.init_scale)
        if self._components.sis:
            scale_m = spacing_m * np.where(active, settings.roi_scale, settings.background_scale).astype(np.float32)
        rows, columns = np.divmod(pixels, frame.camera.width_px)
        depths_m = frame.depth_m[rows, columns].astype(np.float64)
        points = lift(np.stack([columns, rows], axis=1) + 0.5, depths_m, frame.camera)
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
