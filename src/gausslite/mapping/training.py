"""Train the map on a frame: a warm-up over the full image, then the task's region alone (Sec. III-D: ROI, MVO)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, UInt32
from numpy import ndarray

from gausslite.domain.state import State, get_counts, int_array
from gausslite.mapping.keyframes import WindowView
from gausslite.mapping.settings import ActivePhase, MapperSettings
from gausslite.mapping.stages import CountedScheduler, Stage, StageScheduler
from gausslite.optimize.density import densify, prune
from gausslite.optimize.parameters import SplatTable
from gausslite.render.rasterizer import Rasterizer, Subset, UpdateCounter

_COLOUR_RANGE = (-0.25, 1.25)
"""Somewhat beyond what can be shown, so that overlapping Gaussians still add up to black and white."""
_DRAWS = 16
_Rows: TypeAlias = Float32[ndarray, "n 16"]
_Tables: TypeAlias = tuple[_Rows, _Rows, _Rows]


@dataclass(frozen=True, slots=True, eq=False)
class _Loan:
    """What the rasterizer works on until rows move: Adam's tables, and what the active phase is told of their rows."""

    tables: _Tables
    active_ids: UInt32[ndarray, " m"] | None
    trainable: Bool[ndarray, " n"] | None
    update_counter: UpdateCounter

    @classmethod
    def of(cls, table: SplatTable, phase: ActivePhase) -> _Loan:
        """All of this table, for as long as it is neither grown nor shrunk. Kappa counts active Gaussians only."""
        return cls(
            tables=(table.rows, table.first_moment, table.second_moment),
            active_ids=np.flatnonzero(table.active).astype(np.uint32) if phase is ActivePhase.ACTIVE_ONLY else None,
            trainable=table.active if phase is ActivePhase.FROZEN_BACKGROUND else None,
            update_counter=UpdateCounter(table.kappa, table.active),
        )


class Trainer:
    """Runs the iterations of a mapped frame and the density control that goes by their count."""

    def __init__(
        self, settings: MapperSettings, table: SplatTable, rasterizer: Rasterizer, rng: np.random.Generator
    ) -> None:
        self._settings = settings
        self._adam = settings.adam
        self._table = table
        self._rasterizer = rasterizer
        self._rng = rng
        self._iterations = 0
        self._since_pruned = 0
        self._since_densified = 0

    @property
    def iterations(self) -> int:
        """Iterations run since the start."""
        return self._iterations

    def state(self) -> State:
        """The counts by which density control takes its turns; between two frames nothing else is kept."""
        return {"counts": int_array(self._iterations, self._since_pruned, self._since_densified)}

    def restore(self, state: State) -> None:
        """Go on where another trainer stood. Raises MapFileError."""
        self._iterations, self._since_pruned, self._since_densified = get_counts(state, "counts", 3)

    def train(self, views: Sequence[WindowView], extent_m: float, scheduler: StageScheduler) -> int:
        """Train on these views for as long as the scheduler allows and return the number of iterations.

        The two phases take turns in the settings' proportion, a warm-up first. Where the time left is too short for
        another, or for the frame's least iterations after it, active ones take its place.
        """
        showing = self._showing_region(views)
        done, time_is_up = 0, False
        while not time_is_up:
            done, time_is_up = self._until_density_control(views, showing, done, scheduler)
            self._control_density(extent_m, scheduler)
        with scheduler.timing(Stage.FINALISATION):
            self._bound_colours()
            if self._settings.optimization.isotropic:
                self._make_spheres()
            self._average()
        return done

    def idle_step(self, views: Sequence[WindowView], extent_m: float) -> None:
        """One iteration on views of earlier frames, for time in which none waits; the phases take turns as ever."""
        showing, scheduler = self._showing_region(views), CountedScheduler()
        step = self._next_step(self._iterations, bool(showing), scheduler)
        if step is None:
            return
        loan = _Loan.of(self._table, self._settings.optimization.active_phase)
        with self._rasterizer.bind_tables(*loan.tables):
            self._iterate(loan, step, views if step is Stage.WARM_UP else showing, self._rng.random())
        self._control_density(extent_m, scheduler)
        self._bound_colours()
        if self._iterations % self._settings.optimization.iterations == 0:
            self._average()

    def _showing_region(self, views: Sequence[WindowView]) -> list[WindowView]:
        """The views of the active phase; none where the component is off, so that all iterations are warm-ups."""
        optimization = self._settings.optimization
        if not self._settings.components.roi or optimization.active_iterations == 0:
            return []
        return [view for view in views if view.shows_region]

    def _next_step(self, done: int, region_in_view: bool, scheduler: StageScheduler) -> Stage | None:
        optimization = self._settings.optimization
        counted = optimization.iterations
        warming_up = not region_in_view or done % counted < optimization.warmup_iterations
        if region_in_view and done > 0:
            warming_up = warming_up and scheduler.has_time_for(Stage.WARM_UP)
        if warming_up and scheduler.trains_on(Stage.WARM_UP, counted):
            return Stage.WARM_UP
        return Stage.ACTIVE if region_in_view and scheduler.trains_on(Stage.ACTIVE, counted) else None

    def _until_density_control(
        self, views: Sequence[WindowView], showing: Sequence[WindowView], done: int, scheduler: StageScheduler
    ) -> tuple[int, bool]:
        """Iterate until density control is due or time is up, the tables on loan to the rasterizer; `done` and which
        of both then.
        """
        loan = _Loan.of(self._table, self._settings.optimization.active_phase)
        draws = _uniform(self._rng)
        with self._rasterizer.bind_tables(*loan.tables):
            while (step := self._next_step(done, bool(showing), scheduler)) is not None:
                with scheduler.timing(step):
                    self._iterate(loan, step, views if step is Stage.WARM_UP else showing, next(draws))
                done += 1
                if self._prune_is_due(scheduler) or self._densify_is_due(scheduler):
                    return done, False
        return done, True

    def _iterate(self, loan: _Loan, step: Stage, views: Sequence[WindowView], draw: float) -> None:
        """One iteration on the view that `draw`, from 0 to 1, picks: its full image, or the task's region alone."""
        view = views[int(draw * len(views))]
        if step is Stage.WARM_UP:
            self._warm_up(loan, view)
        else:
            self._active_phase(loan, view)
        self._iterations += 1
        self._since_pruned += 1
        self._since_densified += 1

    def _warm_up(self, loan: _Loan, view: WindowView) -> None:
        optimization = self._settings.optimization
        self._rasterizer.step(*loan.tables, view.training_view, view.T_camera_world, optimization.loss, self._adam)

    def _active_phase(self, loan: _Loan, view: WindowView) -> None:
        optimization = self._settings.optimization
        self._rasterizer.step(
            *loan.tables,
            view.training_view,
            view.T_camera_world,
            optimization.loss,
            self._adam,
            masked=True,
            subset=view.region if loan.active_ids is None else Subset(view.region.tiles, loan.active_ids),
            trainable=loan.trainable,
            update_counter=loan.update_counter,
        )

    def _make_spheres(self) -> None:
        """Each Gaussian gets the geometric mean of its scales."""
        self._table.make_isotropic()

    def _bound_colours(self) -> None:
        """Colours that no view checks for a while must not run away."""
        self._table.clip_colours(*_COLOUR_RANGE)

    def _average(self) -> None:
        if self._settings.optimization.ema_updates > 0:
            self._table.update_ema(self._settings.optimization.ema_updates)

    def _prune_is_due(self, scheduler: StageScheduler) -> bool:
        return _due(self._since_pruned, self._settings.density.prune_every, Stage.PRUNING, scheduler)

    def _densify_is_due(self, scheduler: StageScheduler) -> bool:
        return _due(self._since_densified, self._settings.density.densify_every, Stage.DENSIFICATION, scheduler)

    def _control_density(self, extent_m: float, scheduler: StageScheduler) -> None:
        """Clone, split and prune when their turn has come, and later where a frame has no time for it."""
        density = self._settings.density
        if self._prune_is_due(scheduler):
            with scheduler.timing(Stage.PRUNING):
                prune(self._table, density)
            self._since_pruned = 0
        if self._densify_is_due(scheduler):
            with scheduler.timing(Stage.DENSIFICATION):
                densify(self._table, density, extent_m)
            self._since_densified = 0


def _uniform(rng: np.random.Generator) -> Iterator[float]:
    """Numbers in [0, 1), drawn some at a time: between two iterations a call of the generator is dear."""
    while True:
        yield from rng.random(_DRAWS).tolist()


def _due(since: int, every: int, step: Stage, scheduler: StageScheduler) -> bool:
    """Density control may be late by as many iterations again as lie between two of its turns."""
    return since >= 2 * every or (since >= every and scheduler.has_time_for(step))
