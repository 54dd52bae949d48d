"""Refine the fused map by a short joint optimisation on all agents' keyframes (Sec. III-E)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.fusion.refinement import RefineProgress, RefineSettings
from gausslite.mapping.settings import BALANCED_LOSS, ONLINE_RATES
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import (
    Rasterizer,
    Subset,
    TrainingView,
    UpdateCounter,
    rows_to_gaussians,
)
from gausslite_refinement.refine_input import RefineInput
from gausslite_refinement.views import BACKGROUND, RefineView, agreeing, views_of

_Rows = Float32[ndarray, "n 16"]
_CYCLE, _WHOLE = 8, 2
"""Of eight iterations, two train whole images, as the mapper's; the others train the agents' regions in turn."""
_REGION_VIEWS = 8
_HELD_OUT_EVERY, _FIRST_HELD_OUT = 8, 4
_PATIENCE = 4
"""Checks without an improvement after which a refinement ends."""
_UPDATES = 400
"""Weight of a refinement against the most kappa updates of a voxel's Gaussians in the mission.

In the demo, 50, 200 and 1000 change the mug by +0.06, +0.05 and -0.05 dB, the chair by +0.5, +0.9 and +1.9 dB.
"""
_MIN_ITERATIONS, _GAUSSIANS_PER_ITERATION = 500, 200
_DEPTH_EDGE_PX = 2
"""Depth within this distance of a depth jump is not trained."""
_CONTEXT_WEIGHT = 0.3
"""Weight of pixels around a region."""
_RATES = replace(ONLINE_RATES, means=2e-4, decay_after_updates=20)
"""The mapper's rates, those of the means twice the 3DGS rate, with decay from the 20th update of a Gaussian on. A joint
refinement ends, and its last large steps would remain as noise. Over the 3DGS rates, 500 iterations gain 0.2 dB in the
region and 1.0 dB over the whole image of the simulated home. The decay gains 0.9 dB in the region (fitted views) on a
real kitchen with the frames of two robots, and 0.2 dB on simulated homes.
"""


class Refinement:
    """A joint optimisation of every Gaussian of a map; keeps the state that the held-out keyframes show best.

    sources: the agents whose keyframes train. left_out: those of which keyframes disagree with the vote, and how many.
    Raises InvalidInputError if no keyframe agrees with the map, QuotaError if the map exceeds max_gaussians.
    """

    def __init__(self, vote: RefineInput, rasterizer: Rasterizer, settings: RefineSettings) -> None:
        self._rasterizer, self._settings = rasterizer, settings
        self._table = _fill_table(vote.gaussians, settings)
        shown = views_of(self._table.rows, vote, rasterizer)
        views, self.left_out = agreeing(shown, vote.regions.keys())
        if not views:
            raise InvalidInputError(
                f"refine: expected keyframes that show the fused map, got {len(vote.keyframes)}: {len(shown)} show it, "
                f"none as the vote does"
            )
        self.sources = tuple(sorted({view.agent_id for view in views}))
        self._pool = _ViewPool(views, len(vote.regions), rasterizer, settings)
        self._first_errors = self._pool.errors(self._table.rows)
        self._vote_rows = self._best_rows = self._table.rows.copy()
        self._mean_rows, self._states, self._best_score = self._vote_rows.copy(), 1, 0.0
        voxel = np.unique(vote.grid.keys(vote.gaussians.means_m), return_inverse=True)[1]
        kappa = np.zeros(len(voxel), np.float32)
        np.maximum.at(kappa, voxel, vote.gaussians.kappa)
        self._share = (_UPDATES / (_UPDATES + kappa[voxel, None])).astype(np.float32)
        self._iterations = settings.iterations or min(
            max(_MIN_ITERATIONS, len(vote.gaussians) // _GAUSSIANS_PER_ITERATION), MAX_REFINE_ITERATIONS
        )

    def steps(self) -> Iterator[RefineProgress]:
        """Optimise, once; yields every report_every iterations and at the end. It stops where its reader does."""
        settings, failures = self._settings, 0
        draws = self._pool.draws(np.random.default_rng(settings.seed))
        for first in range(1, self._iterations + 1, settings.check_every):
            last = min(first + settings.check_every - 1, self._iterations)
            with self._rasterizer.bind_tables(*_tables(self._table)):
                for iteration in range(first, last + 1):
                    loss = self._step(next(draws))
                    if iteration % settings.report_every == 0 and iteration < last:
                        yield RefineProgress(iteration, self._iterations, loss, self._table.count, self.left_out)
            failures = 0 if self._keep_if_best() else failures + 1
            ends = last == self._iterations or failures == _PATIENCE
            yield RefineProgress(last, last if ends else self._iterations, loss, self._table.count, self.left_out)
            if ends:
                return

    def _step(self, views: Sequence[_Prepared]) -> float:
        for training_view, subset, _, T_camera_world in views:
            report = self._rasterizer.step(
                *_tables(self._table),
                view=training_view,
                T_camera_world=T_camera_world,
                loss=BALANCED_LOSS,
                adam=_RATES,
                masked=True,
                subset=subset,
                update_counter=UpdateCounter(self._table.kappa),
            )
        return report.loss

    def _keep_if_best(self) -> bool:
        """Keep the mean of the states if it is the best yet, and nowhere worse than the vote; returns whether it is.

        The mean has less noise than the last state. A voxel that its mission trained often stays near the vote,
        because the mission had all frames: off the keyframes' paths, the demo's mug would lose 0.7 dB.
        """
        self._states += 1
        self._mean_rows += (self._table.rows - self._mean_rows) / np.float32(self._states)
        rows = self._vote_rows + self._share * (self._mean_rows - self._vote_rows)
        ratios = self._pool.errors(rows) / self._first_errors
        score = float(np.log(ratios).sum())
        if score >= self._best_score or (ratios > 1.0).any():
            return False
        self._best_rows, self._best_score = rows, score
        return True

    def result(self) -> Gaussians:
        """Return the best map, the vote if no other is. The Gaussians of the tasks' regions are active."""
        table = self._table
        return rows_to_gaussians(self._best_rows, table.target != NO_TARGET, table.kappa, table.target)


def _tables(table: SplatTable) -> tuple[_Rows, _Rows, _Rows]:
    return table.rows, table.first_moment, table.second_moment


def _fill_table(gaussians: Gaussians, settings: RefineSettings) -> SplatTable:
    count = len(gaussians)
    if count == 0:
        raise InvalidInputError("refine: expected a fused map with Gaussians, got an empty one")
    if count > settings.max_gaussians:
        raise QuotaError(f"refine: expected at most {settings.max_gaussians} Gaussians, got {count}")
    table = SplatTable(count)
    table.append(replace(gaussians, active=np.ones(count, np.bool_)))
    return table


_Prepared = tuple[TrainingView, Subset, float, Float64[ndarray, "4 4"]]


class _ViewPool:
    """The views to train on and to judge by. Up to max_prepared_views stay prepared; the others are at each use."""

    def __init__(
        self, views: Sequence[RefineView], regions: int, rasterizer: Rasterizer, settings: RefineSettings
    ) -> None:
        self._views, self._rasterizer, self._settings = views, rasterizer, settings
        self._prepared: dict[tuple[int, int], _Prepared] = {}
        showing = {
            region: [
                number for number, view in enumerate(views) if region == BACKGROUND or (view.region == region).any()
            ]
            for region in range(BACKGROUND, regions)
        }
        held_out = {region: own[_FIRST_HELD_OUT::_HELD_OUT_EVERY] for region, own in showing.items()}
        unused = set().union(*held_out.values())
        trained = {region: [number for number in own if number not in unused] for region, own in showing.items()}
        self._trained = {region: trained[region] or own for region, own in showing.items() if own}
        # a region that few views show is judged by all of them
        self._judges = sorted(set().union(*(held_out[region] or own for region, own in showing.items())))
        self._columns = [region for region, own in showing.items() if own]

    def draws(self, rng: np.random.Generator) -> Iterator[list[_Prepared]]:
        """Yield the views of each iteration without end: a whole image, or an agent's region in one image's tiles.

        The agents have their turns; each view is drawn in proportion to its agreement with the vote.
        """
        regions = itertools.cycle([region for region in self._trained if region != BACKGROUND] or [BACKGROUND])
        for turn in itertools.count():
            region = BACKGROUND if turn % _CYCLE < _WHOLE else next(regions)
            numbers = self._trained[region]
            weights = np.array([self._views[number].agreement for number in numbers])
            views, images = list[_Prepared](), 0.0
            for number in rng.choice(numbers, _REGION_VIEWS, p=weights / weights.sum()).tolist():
                views.append(self._prepare(number, region))
                images += views[-1][2]
                if images + views[-1][2] > 1.0:
                    break
            yield views

    def errors(self, rows: _Rows) -> Float64[ndarray, " c"]:
        """Return the mean squared errors of the judging views: over all that the map explains, and in each region."""
        sums = np.full((len(self._columns), 2), 1e-9)
        for view in (self._views[number] for number in self._judges):
            frame = view.frame
            rendering = self._rasterizer.forward(rows, frame.camera, view.T_camera_world, motion=frame.motion)
            squared = np.square(np.clip(rendering.rgb, 0.0, 1.0) - frame.rgb / np.float32(255.0)).mean(axis=2)
            for column, region in enumerate(self._columns):
                shown = squared[view.region >= BACKGROUND if region == BACKGROUND else view.region == region]
                sums[column] += shown.sum(dtype=np.float64), len(shown)
        means: Float64[ndarray, " c"] = sums[:, 0] / sums[:, 1]
        return means

    def _prepare(self, number: int, region: int) -> _Prepared:
        found = self._prepared.get((number, region))
        if found is None:
            view = self._views[number]
            prepared = view.prepare(self._rasterizer, region, _CONTEXT_WEIGHT, _DEPTH_EDGE_PX)
            found = *prepared, view.T_camera_world
            if len(self._prepared) < self._settings.max_prepared_views:
                self._prepared[number, region] = found
        return found
