"""Refine the fused map by a short joint optimisation on all agents' keyframes (Sec. III-E), and render it.

The fused map usually holds only the task's voxels. So a keyframe is compared only with pixels that the map explains:
inside the footprint of the fused map, and not where the measured surface occludes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.config.option import option
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.frame import Frame, without_depth_edges
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import NO_TARGET
from gausslite.fusion.fused_map import FusedMapLayers, MapLayer
from gausslite.fusion.keyframe_pool import AgentKeyframe
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.mapping.density import densify, prune
from gausslite.mapping.settings import REFINE_RATES, DensitySettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import (
    ROW_WIDTH,
    AdamSettings,
    LossWeights,
    Rasterizer,
    Rendering,
    TrainingView,
    UpdateCounter,
    gaussians_to_rows,
)

_FOOTPRINT_ALPHA = 0.5
_OCCLUSION_M, _OCCLUSION_SHARE = 0.05, 0.05
"""A measured surface occludes the map's if it is closer by this distance plus this share of the depth."""
_Rows = Float32[ndarray, "n 16"]
_View = tuple[Frame, Float32[ndarray, "h w"]]
"""A keyframe, and the weight of each pixel in the loss: 1 in the footprint of the map, otherwise 0."""


@dataclass(frozen=True, slots=True)
class RefineSettings:
    """Length and limits of a refinement. The map may grow by the factor `headroom`, up to max_gaussians.

    Depth within depth_edge_px of a depth jump is not trained. The loss is a mean over each view's footprint. All steps
    are masked, unlike the mapper's. normalise_by_image gave 0.05 dB less.
    """

    iterations: int = option(
        500,
        "iterations of joint refinement if a request states none",
        key="refine-iterations",
        low=1,
        high=MAX_REFINE_ITERATIONS,
    )
    headroom: float = 1.25
    max_gaussians: int = 3_000_000
    seed: int = 0
    report_every: int = 10
    max_prepared_views: int = 48
    depth_edge_px: int = 2
    loss: LossWeights = field(default_factory=LossWeights)
    adam: AdamSettings = REFINE_RATES
    density: DensitySettings = field(default_factory=DensitySettings)

    def __post_init__(self) -> None:
        for name in ("iterations", "max_gaussians", "report_every", "max_prepared_views"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"refine {name}: expected at least 1, got {getattr(self, name)}")
        if not 1.0 <= self.headroom <= 10.0:
            raise InvalidInputError(f"refine headroom: expected 1 to 10, got {self.headroom}")


@dataclass(frozen=True, slots=True)
class RefineProgress:
    """The state of a refinement after `iteration` of `iterations`."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int


CreateRasterizer = Callable[[], Rasterizer]
"""Creates the rasterizer of a refinement when it starts: a server without refinements needs no kernels."""


class Refinement:
    """A joint optimisation of every Gaussian of a map.

    Raises InvalidInputError if no keyframe shows the map, QuotaError if the map exceeds max_gaussians.
    """

    def __init__(
        self, gaussians: Gaussians, keyframes: Sequence[AgentKeyframe], rasterizer: Rasterizer, settings: RefineSettings
    ) -> None:
        self._rasterizer, self._settings = rasterizer, settings
        self._table = _fill_table(gaussians, settings)
        self._views = _ViewPool(_footprints(self._table, keyframes, rasterizer), rasterizer, settings)
        self._extent_m = _extent_m(gaussians)

    def steps(self) -> Iterator[RefineProgress]:
        """Optimise, once; yields every report_every iterations and at the end. It stops where its reader does."""
        table, rasterizer, settings = self._table, self._rasterizer, self._settings
        rng = np.random.default_rng(settings.seed)
        with ExitStack() as binding:
            binding.enter_context(rasterizer.bind_tables(*_tables(table)))
            for iteration in range(1, settings.iterations + 1):
                view, T_camera_world = self._views.draw(rng)
                report = rasterizer.step(
                    *_tables(table),
                    view=view,
                    T_camera_world=T_camera_world,
                    loss=settings.loss,
                    adam=settings.adam,
                    masked=True,
                    update_counter=UpdateCounter(table.kappa),
                )
                if iteration % settings.density.densify_every == 0 or iteration % settings.density.prune_every == 0:
                    binding.close()
                    _control_density(table, iteration, settings, self._extent_m)
                    binding.enter_context(rasterizer.bind_tables(*_tables(table)))
                if iteration % settings.report_every == 0 or iteration == settings.iterations:
                    yield RefineProgress(iteration, settings.iterations, report.loss, table.count)

    def result(self) -> Gaussians:
        """Return the map after the steps. The Gaussians of the tasks' regions are active: those that show a target."""
        refined = self._table.to_gaussians()
        return replace(refined, active=refined.target != NO_TARGET)


def _tables(table: SplatTable) -> tuple[_Rows, _Rows, _Rows]:
    return table.rows, table.first_moment, table.second_moment


def _fill_table(gaussians: Gaussians, settings: RefineSettings) -> SplatTable:
    count = len(gaussians)
    if count == 0:
        raise InvalidInputError("refine: expected a fused map with Gaussians, got an empty one")
    if count > settings.max_gaussians:
        raise QuotaError(f"refine: expected at most {settings.max_gaussians} Gaussians, got {count}")
    table = SplatTable(min(int(np.ceil(count * settings.headroom)), settings.max_gaussians))
    table.append(replace(gaussians, active=np.ones(count, np.bool_)))
    return table


def _footprints(table: SplatTable, keyframes: Sequence[AgentKeyframe], rasterizer: Rasterizer) -> list[_View]:
    """Return the keyframes that show some of the map, with the weights of their pixels."""
    views = []
    for frame in (keyframe.frame for keyframe in keyframes):
        rendering = rasterizer.forward(table.rows, frame.camera, inverse(frame.T_world_camera), motion=frame.motion)
        surface_m = rendering.expected_depth_m(_FOOTPRINT_ALPHA)
        occluded = (frame.depth_m > 0) & (frame.depth_m < surface_m * (1 - _OCCLUSION_SHARE) - _OCCLUSION_M)
        pixel_weights = ((rendering.alpha > _FOOTPRINT_ALPHA) & ~occluded).astype(np.float32)
        if pixel_weights.any():
            views.append((frame, pixel_weights))
    if not views:
        raise InvalidInputError(
            f"refine: expected keyframes that show the fused map, got {len(keyframes)} but none does"
        )
    return views


class _ViewPool:
    """The views to draw from. Up to max_prepared_views stay prepared; the others are prepared at each use."""

    def __init__(self, views: list[_View], rasterizer: Rasterizer, settings: RefineSettings) -> None:
        self._views = views
        self._rasterizer = rasterizer
        self._max_prepared, self._depth_edge_px = settings.max_prepared_views, settings.depth_edge_px
        self._prepared: dict[int, TrainingView] = {}

    def draw(self, rng: np.random.Generator) -> tuple[TrainingView, Float64[ndarray, "4 4"]]:
        """Draw a view uniformly from all agents' keyframes; returns it with its T_camera_world."""
        index = int(rng.integers(len(self._views)))
        frame, pixel_weights = self._views[index]
        view = self._prepared.get(index)
        if view is None:
            depth_m = without_depth_edges(frame.depth_m, self._depth_edge_px)
            view = self._rasterizer.prepare_view(frame.rgb, depth_m, frame.camera, pixel_weights, frame.motion)
            if len(self._prepared) < self._max_prepared:
                self._prepared[index] = view
        return view, inverse(frame.T_world_camera)


def _control_density(table: SplatTable, iteration: int, settings: RefineSettings, extent_m: float) -> None:
    """Clone, split and prune as the mapper does, but never prune the whole map."""
    if iteration % settings.density.densify_every == 0 and iteration < settings.iterations:
        densify(table, settings.density, extent_m)
    if iteration % settings.density.prune_every == 0 and (table.opacities >= settings.density.min_opacity).any():
        prune(table, settings.density)


def _extent_m(gaussians: Gaussians) -> float:
    """Return the radius of the map about its centre without the farthest 5 %; at least 1 cm."""
    distance_m = np.linalg.norm(gaussians.means_m - np.median(gaussians.means_m, axis=0), axis=1)
    return max(0.01, float(np.quantile(distance_m, 0.95)))


class _LayerCopy:
    """The rows of a map layer, brought up to date tile by tile, so that the map is held for one tile at a time."""

    def __init__(self) -> None:
        self.rows = np.zeros((0, ROW_WIDTH), np.float32)
        self._revision = 0
        # the revision and the rows of each tile
        self._tiles: dict[int, tuple[int, Float32[ndarray, "n 16"]]] = {}

    def update(self, maps: FusedMapLayers, layer: MapLayer) -> int:
        """Read the tiles that have changed since the latest update; returns the layer's revision before."""
        revision, tiles = maps.tiles(layer)
        if self._revision == revision:
            return revision
        kept, self._tiles = self._tiles, {}
        for tile in tiles.tolist():
            # read before the tile: a change in between makes the copy newer than its revision, never older
            changed_at = maps.tile_revision(layer, tile)
            if tile in kept and kept[tile][0] == changed_at:
                self._tiles[tile] = kept[tile]
            else:
                self._tiles[tile] = changed_at, gaussians_to_rows(maps.tile(layer, tile).batch.gaussians)
        self.rows = np.concatenate([np.zeros((0, ROW_WIDTH), np.float32), *(rows for _, rows in self._tiles.values())])
        self._revision = revision
        return revision


class MapRenderer:
    """Renders on one thread, from an own copy of each layer; the rasterizer is created with the first view."""

    def __init__(self, maps: FusedMapLayers, create_rasterizer: CreateRasterizer) -> None:
        self._maps, self._create_rasterizer = maps, create_rasterizer
        self._rasterizer: Rasterizer | None = None
        self._copies: dict[MapLayer, _LayerCopy] = {}

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], layer: MapLayer
    ) -> tuple[Rendering | None, int]:
        """Return a view of a layer, None of an empty one, and the layer's revision. Raises KernelError."""
        copy = self._copies.setdefault(layer, _LayerCopy())
        revision = copy.update(self._maps, layer)
        if not len(copy.rows):
            return None, revision
        if self._rasterizer is None:
            self._rasterizer = self._create_rasterizer()
        return self._rasterizer.forward(copy.rows, camera, inverse(T_world_camera)), revision
