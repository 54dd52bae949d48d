"""Seed new Gaussians from pixels of a frame, by relevance to the task (Sec. III-C: its budget, scales, gradients)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.camera import lift, project
from gausslite.domain.frame import Frame, with_filled_depth
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.pixel_sampling import (
    edge_magnitude,
    initial_spacing_m,
    neighbour_distance_px,
    sample_pixels,
    sample_stratified,
)
from gausslite.mapping.settings import Components, SeedingSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.render.rasterizer import NEAR_M, Rendering

_CELL_PX = 8
_MAX_RELATIVE_DEPTH_ERROR = 0.05
"""A Gaussian within this fraction of the measured depth lies on the visible surface."""
_MEDIAN_STEP_PX = 4
_RESERVED_VIEWS = 4.0
"""Background seeds leave free slots for this many more images."""
_EDGE_EPSILON = 0.01
"""ε of GFD (Sec. III-C.3)."""
_REFERENCE_PIXELS = 640 * 480
"""Image size of the seed counts in SeedingSettings."""
_MIN_ROI_ROOM = 0.05
"""Lowest density of ROI seeds relative to that of an empty map."""


def rendered_behind(frame: Frame, rendered: Rendering, depth_error_factor: float) -> Bool[ndarray, "h w"]:
    """Return the pixels rendered behind the measured depth by more than depth_error_factor times the median error.

    The median of the absolute depth error is taken over every fourth row and column.
    """
    rendered_m = rendered.expected_depth_m()
    comparable = (frame.depth_m > 0) & (rendered_m > 0)
    behind_m = rendered_m - frame.depth_m
    sample = (slice(None, None, _MEDIAN_STEP_PX), slice(None, None, _MEDIAN_STEP_PX))
    errors_m = np.abs(behind_m[sample][comparable[sample]])  # a sample: the median needs no more
    # the median: what the map really lacks does not raise the limit
    median_m = float(np.median(errors_m)) if len(errors_m) else 0.0
    result: Bool[ndarray, "h w"] = comparable & (behind_m > depth_error_factor * median_m)
    return result


def undersampled_roi(
    frame: Frame, roi: Bool[ndarray, "h w"], active_means_m: Float32[ndarray, "n 3"], pixels_per_gaussian: float
) -> Bool[ndarray, "h w"]:
    """Return ROI pixels in 8x8 cells with less than one active Gaussian per `pixels_per_gaussian` ROI pixels.

    These are mapped as background so far, for example because the detector found the object late.
    """
    if not roi.any():
        return np.zeros_like(roi)
    height, width = roi.shape
    shape = (-(-height // _CELL_PX), -(-width // _CELL_PX))
    rows, columns = np.nonzero(roi & (frame.depth_m > 0))
    min_count = _count_per_cell(rows, columns, shape) / pixels_per_gaussian  # what a dense region would have here
    _, active_rows, active_columns = visible_means(frame, active_means_m)
    count = _count_per_cell(active_rows, active_columns, shape)
    sparse = np.repeat(np.repeat(count < min_count, _CELL_PX, axis=0), _CELL_PX, axis=1)[:height, :width]
    result: Bool[ndarray, "h w"] = sparse & roi & (frame.depth_m > 0)
    return result


def visible_means(
    frame: Frame, means_m: Float32[ndarray, "n 3"]
) -> tuple[Int64[ndarray, " s"], Int64[ndarray, " s"], Int64[ndarray, " s"]]:
    """Return ids (ascending), pixel rows and pixel columns of the means that lie on the frame's visible surface."""
    points = transform_points(inverse(frame.T_world_camera), means_m)
    ids = np.flatnonzero(points[:, 2] > NEAR_M)  # what lies behind the camera has no pixel
    points = points.take(ids, axis=0)
    if frame.motion is not None:
        points = frame.motion.at_exposure(points.astype(np.float64), frame.camera).astype(np.float32)
    x_px, y_px = np.ascontiguousarray(project(points, frame.camera).T)
    height, width = frame.depth_m.shape
    inside = np.flatnonzero((y_px >= 0) & (y_px < height) & (x_px >= 0) & (x_px < width))
    ids, z_m = ids[inside], points[inside, 2]
    rows, columns = y_px[inside].astype(np.int64), x_px[inside].astype(np.int64)
    depth_m = frame.depth_m[rows, columns]
    # others are occluded, or float in front of the surface
    on_surface = np.abs(z_m - depth_m) < _MAX_RELATIVE_DEPTH_ERROR * depth_m
    return ids[on_surface], rows[on_surface], columns[on_surface]


def _count_per_cell(rows: ndarray, columns: ndarray, shape: tuple[int, int]) -> ndarray:
    cells = (rows // _CELL_PX) * shape[1] + columns // _CELL_PX
    return np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)


@dataclass(frozen=True, slots=True, eq=False)
class SeedingContext:
    """State of the map before seeding."""

    free_slots: int  # Gaussians that still fit under the cap
    rendered: Rendering | None  # the map rendered from the frame's pose, None if the map is empty
    active_means_m: Float32[ndarray, "n 3"]  # means of the active Gaussians
    max_active: int | None = None  # how many may be active; None: any number


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """New Gaussians: N_ROI seeds of the ROI, inserted first, and N_bg of the background (without SB: of any pixel)."""

    roi: Gaussians  # N_ROI
    background: Gaussians
    anchor: int = NO_ANCHOR  # number of the keyframe that they follow when poses are corrected


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
        # only measured depth tells what the map lacks
        surface = replace(frame, depth_m=with_filled_depth(frame.depth_m)) if self._settings.fill_depth else frame
        roi_pool, background_pool = self._split_budget(frame, surface, relevance, context)
        return Seeds(
            roi=self._draw(surface, relevance, roi_pool, pixel_weights),
            background=self._draw(surface, relevance, background_pool, pixel_weights),
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
        return self._draw(
            frame,
            relevance,
            self._roi_pool(pixels, budget, settings.roi_pixels_per_gaussian),
            self._pixel_weights(frame),
        )

    def _split_budget(
        self, frame: Frame, surface: Frame, relevance: RelevanceMap, context: SeedingContext
    ) -> tuple[_Pool, _Pool]:
        """SB (Sec. III-C.1): split N into floor(ρN) ROI seeds and the background's; without SB all are background.

        Only pixels that the map does not explain yet are candidates. surface: the frame with the depth of the seeds.
        """
        settings = self._settings
        seeds = settings.first_frame_seeds if context.rendered is None else settings.later_seeds
        budget = max(1, round(seeds * frame.depth_m.size / _REFERENCE_PIXELS))  # N, for this image size
        seedable = (surface.depth_m > 0) & (surface.depth_m <= settings.max_depth_m)
        if surface.left_out is not None:
            seedable &= ~surface.left_out  # the filled depth has values there
        roi_candidates = candidates = seedable  # an empty map explains nothing
        if context.rendered is not None:
            behind = rendered_behind(frame, context.rendered, settings.depth_error_factor)
            candidates = seedable & (behind | (context.rendered.alpha < settings.min_alpha))
            roi_candidates = seedable & (behind | (context.rendered.alpha < settings.roi_min_alpha))
        if not self._components.sb:
            no_roi = _Pool(np.zeros_like(seedable), 0, stratified=False)
            return no_roi, self._background_pool(candidates, budget, context.free_slots)
        roi_budget = int(settings.roi_share * budget)  # floor(ρN): an upper limit, the rest is not handed on
        spacing = self._roi_pixels_per_gaussian(context)
        if settings.fill_sparse_roi:
            sparse = undersampled_roi(frame, relevance.roi, context.active_means_m, spacing)
            roi_candidates = roi_candidates | (sparse & seedable)  # explained, but by too few Gaussians for detail
        roi_pool = self._roi_pool(relevance.roi & roi_candidates, roi_budget, spacing)
        background_budget = budget - roi_budget
        return roi_pool, self._background_pool(candidates & ~relevance.roi, background_budget, context.free_slots)

    def _roi_pixels_per_gaussian(self, context: SeedingContext) -> float:
        """Return the spacing of ROI seeds: a region that fills its share of the cap gets sparser ones."""
        spacing = self._settings.roi_pixels_per_gaussian
        if context.max_active is None:
            return spacing
        room = 1.0 - len(context.active_means_m) / max(context.max_active, 1)
        return spacing / max(room, _MIN_ROI_ROOM)

    def _roi_pool(self, pixels: Bool[ndarray, "h w"], budget: int, pixels_per_gaussian: float) -> _Pool:
        """Limit the ROI seeds to one per `pixels_per_gaussian` pixels. Eviction frees slots for them."""
        max_count = int(np.ceil(np.count_nonzero(pixels) / pixels_per_gaussian))
        return _Pool(pixels, min(budget, max_count), stratified=False)

    def _background_pool(self, pixels: Bool[ndarray, "h w"], budget: int, free_slots: int) -> _Pool:
        """Limit the density of seeds so that _RESERVED_VIEWS more full images would fit under the cap.

        Otherwise the first views would fill the map. With fewer free slots, seeds are sparser and start larger.
        """
        settings = self._settings
        max_density = settings.first_frame_seeds / _REFERENCE_PIXELS
        affordable = free_slots / (_RESERVED_VIEWS * pixels.size)
        density = min(max_density, max(affordable, settings.min_density_ratio * max_density))
        count = min(budget, int(np.ceil(density * np.count_nonzero(pixels))))
        return _Pool(pixels, count, stratified=self._components.sis)

    def _pixel_weights(self, frame: Frame) -> Float32[ndarray, "h w"]:
        """GFD (Sec. III-C.3): return E(u, v) + ε, the sampling weight of each pixel; without GFD it is uniform."""
        if not self._components.gfd:
            return np.ones(frame.depth_m.shape, np.float32)
        edges = edge_magnitude(frame.rgb)
        return edges + np.float32(_EDGE_EPSILON)

    def _draw(
        self, frame: Frame, relevance: RelevanceMap, pool: _Pool, pixel_weights: Float32[ndarray, "h w"]
    ) -> Gaussians:
        """Draw pixels from the pool and return their Gaussians."""
        sample = sample_stratified if pool.stratified else sample_pixels
        pixels = sample(pool.pixels, pool.count, pixel_weights, self._rng)
        if len(pixels) == 0:
            return Gaussians.empty()
        distance_px = neighbour_distance_px(pixels, pool.pixels, pool.stratified)
        spacing_m = initial_spacing_m(distance_px, frame.depth_m.ravel()[pixels], frame.camera)  # s0 of Eq. (1)
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
            # Eq. (1): a few iterations cannot shrink a large Gaussian, and large ones bleed into the region
            scale_m = spacing_m * np.where(active, settings.roi_scale, settings.background_scale).astype(np.float32)
        rows, columns = np.divmod(pixels, frame.camera.width_px)
        depths_m = frame.depth_m[rows, columns].astype(np.float64)
        points = lift(np.stack([columns, rows], axis=1) + 0.5, depths_m, frame.camera)
        if frame.motion is not None:
            # each row saw the world from a pose of its own
            points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
        return Gaussians(
            means_m=transform_points(frame.T_world_camera, points).astype(np.float32),
            quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            scales_m=np.repeat(scale_m[:, None], 3, axis=1),
            opacities=np.full(count, settings.opacity, np.float32),
            rgb=frame.rgb.reshape(-1, 3)[pixels].astype(np.float32) / np.float32(255.0),
            active=active,
            kappa=np.zeros(count, np.uint32),  # nothing has trained it yet
            target=relevance.target.ravel()[pixels],
        )


def insert_seeds(
    table: SplatTable, seeds: Seeds, seed_opacity: float, rng: np.random.Generator, min_background: int = 0
) -> int:
    """Insert the ROI seeds, then the background seeds, and return how many; the table never exceeds its capacity.

    ROI seeds evict background Gaussians first (those active in an earlier task before the others), then active ones,
    each in the order of opacity. At least min_background inactive Gaussians stay, so that an ROI as large as the image
    does not fill the map. Background seeds evict only inactive Gaussians less opaque than seed_opacity. Seeds beyond
    the remaining capacity are dropped at random. Seeds reuse the evicted rows, so that few rows move.
    """
    # the task comes first: its seeds make room for themselves
    evicted = _evict_for_roi(table, len(seeds.roi) - table.free_slots, min_background)
    roi = seeds.roi.take(_random_subset(len(seeds.roi), table.free_slots + len(evicted), rng))
    _write(table, roi, evicted, seeds.anchor)
    evicted = _evict_for_background(table, len(seeds.background) - table.free_slots, seed_opacity)
    capacity = table.free_slots + len(evicted)
    background = seeds.background.take(_random_subset(len(seeds.background), capacity, rng))
    _write(table, background, evicted, seeds.anchor)
    return len(roi) + len(background)


def _write(table: SplatTable, seeds: Gaussians, evicted: Int64[ndarray, " m"], anchor: int) -> None:
    """Write the first seeds to the evicted rows and the others to free slots."""
    table.replace(evicted, seeds.take(np.arange(len(evicted))), anchor)
    table.append(seeds.take(np.arange(len(evicted), len(seeds))), anchor)


def _evict_for_roi(table: SplatTable, count: int, min_background: int) -> Int64[ndarray, " k"]:
    """Return up to `count` rows: inactive ones, except min_background of them, then active ones."""
    if count <= 0:
        return np.zeros(0, np.int64)
    evictable = max(0, int(np.count_nonzero(~table.active)) - min_background)
    background = _least_opaque_inactive(table, min(count, evictable), ~table.active)
    roi = table.most_transparent(np.flatnonzero(table.active), count - len(background))
    return np.concatenate([background, roi])


def _evict_for_background(table: SplatTable, count: int, max_opacity: float) -> Int64[ndarray, " k"]:
    """Return up to `count` rows of inactive Gaussians less opaque than max_opacity."""
    if count <= 0:
        return np.zeros(0, np.int64)
    return _least_opaque_inactive(table, count, ~table.active & table.has_lower_opacity(max_opacity))


def _least_opaque_inactive(table: SplatTable, count: int, candidates: Bool[ndarray, " n"]) -> Int64[ndarray, " k"]:
    """Return up to `count` candidates, the least opaque; those active in an earlier task (kappa > 0) come first."""
    was_active = table.kappa > 0
    # a finished task has sent them to the team
    earlier_roi = table.most_transparent(np.flatnonzero(candidates & was_active), count)
    others = table.most_transparent(np.flatnonzero(candidates & ~was_active), count - len(earlier_roi))
    return np.concatenate([earlier_roi, others])


def _random_subset(count: int, capacity: int, rng: np.random.Generator) -> Int64[ndarray, " n"]:
    """Return the indices 0 .. count - 1, or a random subset of `capacity` of them, ascending."""
    if count <= capacity:
        return np.arange(count)
    return np.sort(rng.choice(count, capacity, replace=False))
