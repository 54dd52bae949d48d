"""Smooth the seams between the agents' contributions: a short joint optimisation on everyone's keyframes (Sec. III-E).

The fused map usually holds the task's voxels alone, without the room around them. A keyframe then teaches only where
that map is what it shows: inside the footprint of the map as it was voted, and not where something stands in front.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.errors import InvalidInputError, QuotaError
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.optimize.density import DensitySettings, densify, prune
from gausslite.optimize.parameters import SplatTable
from gausslite.optimize.rates import REFINE_RATES
from gausslite.render.rasterizer import AdamSettings, LossWeights, Rasterizer, StepReport, TrainingView, UpdateCounter

_FOOTPRINT_ALPHA = 0.5
_IN_FRONT_M, _IN_FRONT_SHARE = 0.05, 0.05
"""A surface measured this much (plus this share of the depth) before the map's hides it."""


@dataclass(frozen=True, slots=True)
class RefineSettings:
    """How long and how freely to refine. The map may grow by the factor headroom, never beyond max_gaussians.

    loss: a mean over each view's footprint. All steps are masked, unlike the mapper's; by share gave 0.05 dB less.
    """

    iterations: int = 500
    headroom: float = 1.25
    max_gaussians: int = 3_000_000
    seed: int = 0
    report_every: int = 10
    max_prepared_views: int = 48
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
    """Where a refinement stands after `iteration` of `iterations`."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int


GoOn = Callable[[RefineProgress], bool]
"""Called every report_every iterations and at the end; answering False stops the refinement there."""


def refine(
    gaussians: Gaussians,
    keyframes: Sequence[AgentKeyframe],
    rasterizer: Rasterizer,
    settings: RefineSettings,
    go_on: GoOn,
) -> Gaussians:
    """The map after joint optimisation with every Gaussian active; what was reached so far when stopped.

    Raises InvalidInputError when there is nothing to learn from, QuotaError when the map exceeds max_gaussians.
    """
    table = _fill_table(gaussians, settings)
    views = _Views(_teaching_views(table, keyframes, rasterizer), rasterizer, settings)
    extent_m = _extent_m(gaussians)
    rng = np.random.default_rng(settings.seed)
    with ExitStack() as loan:
        loan.enter_context(_bind_tables(table, rasterizer))
        for iteration in range(1, settings.iterations + 1):
            view, T_camera_world = views.draw(rng)
            report = _train(table, view, T_camera_world, rasterizer, settings)
            if _density_control_is_due(iteration, settings.density):
                loan.close()
                _control_density(table, iteration, settings, extent_m)
                loan.enter_context(_bind_tables(table, rasterizer))
            due = iteration % settings.report_every == 0 or iteration == settings.iterations
            if due and not go_on(RefineProgress(iteration, settings.iterations, report.loss, table.count)):
                break
    return table.to_gaussians()


def _bind_tables(table: SplatTable, rasterizer: Rasterizer) -> AbstractContextManager[None]:
    return rasterizer.bind_tables(table.rows, table.first_moment, table.second_moment)


def _fill_table(gaussians: Gaussians, settings: RefineSettings) -> SplatTable:
    count = len(gaussians)
    if count == 0:
        raise InvalidInputError("refine: expected a fused map with Gaussians, got an empty one")
    if count > settings.max_gaussians:
        raise QuotaError(f"refine: expected at most {settings.max_gaussians} Gaussians, got {count}")
    table = SplatTable(min(int(np.ceil(count * settings.headroom)), settings.max_gaussians))
    table.append(replace(gaussians, active=np.ones(count, np.bool_)))
    return table


@dataclass(frozen=True, slots=True, eq=False)
class _RefinementView:
    """A keyframe and where it teaches."""

    keyframe: AgentKeyframe
    weight: Float32[ndarray, "h w"]
    T_camera_world: Float64[ndarray, "4 4"]


def _teaching_views(
    table: SplatTable, keyframes: Sequence[AgentKeyframe], rasterizer: Rasterizer
) -> list[_RefinementView]:
    """The keyframes that show something of the map, with the weight of their pixels."""
    lessons = []
    for keyframe in keyframes:
        frame = keyframe.frame
        T_camera_world = inverse(frame.T_world_camera)
        rendering = rasterizer.forward(table.rows, frame.camera, T_camera_world)
        surface_m = rendering.expected_depth_m(_FOOTPRINT_ALPHA)
        hidden = (frame.depth_m > 0) & (frame.depth_m < surface_m * (1 - _IN_FRONT_SHARE) - _IN_FRONT_M)
        weight = ((rendering.alpha > _FOOTPRINT_ALPHA) & ~hidden).astype(np.float32)
        if keyframe.weight is not None:
            weight *= keyframe.weight
        if weight.any():
            lessons.append(_RefinementView(keyframe, weight, T_camera_world))
    if not lessons:
        raise InvalidInputError(
            f"refine: expected keyframes that show the fused map, got {len(keyframes)} of which none does"
        )
    return lessons


class _Views:
    """The pool to draw from. As many views as max_prepared_views stay prepared; others are prepared at each use."""

    def __init__(self, lessons: list[_RefinementView], rasterizer: Rasterizer, settings: RefineSettings) -> None:
        self._lessons = lessons
        self._rasterizer = rasterizer
        self._max_prepared = settings.max_prepared_views
        self._prepared: dict[int, TrainingView] = {}

    def draw(self, rng: np.random.Generator) -> tuple[TrainingView, Float64[ndarray, "4 4"]]:
        """A view drawn uniformly from the union of the agents' buffers."""
        index = int(rng.integers(len(self._lessons)))
        lesson = self._lessons[index]
        view = self._prepared.get(index)
        if view is None:
            frame = lesson.keyframe.frame
            view = self._rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera, lesson.weight)
            if len(self._prepared) < self._max_prepared:
                self._prepared[index] = view
        return view, lesson.T_camera_world


def _train(
    table: SplatTable,
    view: TrainingView,
    T_camera_world: Float64[ndarray, "4 4"],
    rasterizer: Rasterizer,
    settings: RefineSettings,
) -> StepReport:
    return rasterizer.step(
        table.rows,
        table.first_moment,
        table.second_moment,
        view,
        T_camera_world,
        settings.loss,
        settings.adam,
        masked=True,
        update_counter=UpdateCounter(table.kappa),
    )


def _density_control_is_due(iteration: int, density: DensitySettings) -> bool:
    return iteration % density.densify_every == 0 or iteration % density.prune_every == 0


def _control_density(table: SplatTable, iteration: int, settings: RefineSettings, extent_m: float) -> None:
    """Clone, split and prune as the mapper does; a map that would vanish altogether is left alone."""
    if iteration % settings.density.densify_every == 0 and iteration < settings.iterations:
        densify(table, settings.density, extent_m)
    if iteration % settings.density.prune_every == 0 and (table.opacities >= settings.density.min_opacity).any():
        prune(table, settings.density)


def _extent_m(gaussians: Gaussians) -> float:
    """Radius of the map round its centre, without its farthest 5 %; at least a centimetre."""
    away_m = np.linalg.norm(gaussians.means_m - np.median(gaussians.means_m, axis=0), axis=1)
    return max(0.01, float(np.quantile(away_m, 0.95)))
