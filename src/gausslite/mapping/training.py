"""Train the map on a frame: a warm-up over the full image, then the task's region alone (Sec. III-D: ROI, MVO)."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from gausslite.mapping.keyframes import WindowView
from gausslite.mapping.settings import ActivePhase, MapperSettings
from gausslite.optimize.density import densify, prune
from gausslite.optimize.parameters import SplatTable
from gausslite.render.rasterizer import EVERYTHING, RGB, Rasterizer, StepReport, Subset

_COLOUR_RANGE = (-0.25, 1.25)
"""Somewhat beyond what can be shown, so that overlapping Gaussians still add up to black and white."""
_READ_EVERY = 8
"""So many reports of the active phase wait to be read together, so that a device runs on meanwhile."""


class Trainer:
    """Runs the iterations of a mapped frame and the density control that goes by their count."""

    def __init__(
        self, settings: MapperSettings, table: SplatTable, rasterizer: Rasterizer, rng: np.random.Generator
    ) -> None:
        self._settings = settings
        self._table = table
        self._rasterizer = rasterizer
        self._rng = rng
        self._iterations = 0
        self._unread: list[StepReport] = []

    @property
    def iterations(self) -> int:
        """Iterations run since the start."""
        return self._iterations

    def train(self, views: Sequence[WindowView], extent_m: float, ends_at_s: float | None) -> int:
        """Train on these views and return the number of iterations.

        Without a deadline that is the number in the settings; with one, iterations go on until time.perf_counter()
        passes ends_at_s, repeating the two phases in the settings' proportion.
        """
        done = 0
        while self._goes_on(done, ends_at_s):
            done = self._until_density_control(views, done, ends_at_s)
            self._control_density(extent_m)
        self._bound_colours()
        return done

    def _until_density_control(self, views: Sequence[WindowView], done: int, ends_at_s: float | None) -> int:
        """Iterate until density control is due or time is up, the tables on loan to the rasterizer; `done` then."""
        table, optimization = self._table, self._settings.optimization
        with self._rasterizer.holding(table.rows, table.first_moment, table.second_moment):
            while True:
                if done % optimization.iterations < optimization.warmup_iterations:
                    self._warm_up(views)
                else:
                    self._active_phase(views)
                done += 1
                self._iterations += 1
                if self._density_control_is_due() or not self._goes_on(done, ends_at_s):
                    break
        self._count_trained()
        return done

    def _goes_on(self, done: int, ends_at_s: float | None) -> bool:
        iterations = self._settings.optimization.iterations
        if ends_at_s is None or iterations == 0:
            return done < iterations
        return time.perf_counter() < ends_at_s

    def _warm_up(self, views: Sequence[WindowView]) -> None:
        """One iteration over the full image of a view drawn at random."""
        self._step(self._draw(views), masked=False, subset=EVERYTHING)

    def _active_phase(self, views: Sequence[WindowView]) -> None:
        """One iteration over the task's region; a warm-up where the component is off or no view shows the region."""
        if not self._settings.components.roi:
            return self._warm_up(views)
        view = self._draw(views)
        if not view.shows_region:
            showing = [other for other in views if other.shows_region]
            if not showing:
                return self._warm_up(views)
            view = self._draw(showing)
        table, phase = self._table, self._settings.optimization.active_phase
        ids = np.flatnonzero(table.active).astype(np.uint32) if phase is ActivePhase.ACTIVE_ONLY else None
        self._unread.append(self._step(view, masked=True, subset=Subset(tiles=view.active_tiles, ids=ids)))
        if len(self._unread) == _READ_EVERY:
            self._count_trained()
        return None

    def _count_trained(self) -> None:
        """Kappa: active Gaussians that an iteration of the active phase trained."""
        table = self._table
        for report in self._unread:
            visible = report.visible
            table.kappa[visible[table.active[visible]]] += 1
        self._unread.clear()

    def _step(self, view: WindowView, masked: bool, subset: Subset) -> StepReport:
        table, optimization = self._table, self._settings.optimization
        frozen = masked and optimization.active_phase is ActivePhase.FROZEN_BACKGROUND
        return self._rasterizer.step(
            table.rows,
            table.first_moment,
            table.second_moment,
            view.training_view,
            view.T_camera_world,
            optimization.loss,
            optimization.adam,
            masked=masked,
            subset=subset,
            trainable=table.active if frozen else None,
        )

    def _draw(self, views: Sequence[WindowView]) -> WindowView:
        return views[int(self._rng.integers(len(views)))]

    def _bound_colours(self) -> None:
        """Colours that no view checks for a while must not run away."""
        colours = self._table.rows[:, RGB]
        np.clip(colours, *_COLOUR_RANGE, out=colours)

    def _density_control_is_due(self) -> bool:
        density = self._settings.density
        return self._iterations % density.prune_every == 0 or self._iterations % density.densify_every == 0

    def _control_density(self, extent_m: float) -> None:
        """Clone, split and prune when their turn has come."""
        density = self._settings.density
        if self._iterations % density.prune_every == 0:
            prune(self._table, density)
        if self._iterations % density.densify_every == 0:
            densify(self._table, density, extent_m, self._rng)
