"""Train the map on a frame: warm-up over full images, then the ROI alone (Sec. III-D.1, ROI; III-D.2, MVO; Eq. 2).

Saturation: the loss of an active step is compared with that of the previous one on the same view. Where visits hardly
lower it, iterations are released to whole images. With 8 active views, a region's first frame may have the 32 visits of
the mean, and 0.7 is released after it. In simulated homes, releases cost regions 0.2 to 1.2 dB, and whole images gain
1.3 to 2.9 dB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import FrameId
from gausslite.domain.state import State, add_prefix, get_array, get_counts, get_floats, int_array, select_prefix
from gausslite.mapping.density import densify, prune
from gausslite.mapping.settings import MapperSettings, SaturationSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.mapping.stages import CountedScheduler, Stage, StageScheduler
from gausslite.mapping.view_rotation import ViewRotation
from gausslite.mapping.window_view import WindowView
from gausslite.render.rasterizer import AdamSettings, Rasterizer, Subset, UpdateCounter

_HORIZON_VISITS = 32
"""Steps behind the running mean; no iteration is released before that many."""
_MAX_CHANGE = 0.3
"""Bound of one visit's change of the log loss: a refined pose may change the loss of a view at once."""
_MAX_VIEWS = 256
"""Views whose last loss is kept, those visited last."""
_COLOUR_RANGE = (-0.25, 1.25)
"""Wider than [0, 1], so that blended colours still reach black and white."""
_HALF_SIZE_VIEWS = 4
_LOADED_UPDATES = 2000
"""Updates that a Gaussian of another map counts as. A second walk through half of sim:home takes from the views of the
first one 3.0 dB with 0, 1.7 with 150, 1.1 with 2000, and 0.6 with 20 000, which costs its own views 0.5 dB."""
_Tables: TypeAlias = tuple[Float32[ndarray, "n 16"], Float32[ndarray, "n 16"], Float32[ndarray, "n 16"]]


class RegionSaturation:
    """Running mean of the region's improvement per visit of a view. Deterministic: it draws no random numbers."""

    def __init__(self, settings: SaturationSettings) -> None:
        self._settings = settings
        self.reset()

    @property
    def enabled(self) -> bool:
        """False if no iteration is ever released; then reading the loss, which may wait for a device, is not needed."""
        return self._settings.max_released > 0

    def reset(self) -> None:
        """Forget all measurements: a new task has another region."""
        self._last_loss: dict[int, float] = {}
        self._improvement, self._visits, self._credit = 0.0, 0, 0.0

    @property
    def released_share(self) -> float:
        """Share of the active iterations to run on whole images instead, in [0, max_released]."""
        settings = self._settings
        if self._visits < _HORIZON_VISITS:  # with one active view, several frames; with 8, one frame
            return 0.0
        share = (settings.improving - self._improvement) / (settings.improving - settings.saturated)
        return min(max(share, 0.0), 1.0) * settings.max_released

    def observe(self, frame: FrameId, loss: float) -> None:
        """Compare the loss of an active step with the previous one on the view of this frame."""
        if not 0.0 < loss < math.inf:  # a view without measured pixels says nothing
            return
        view = frame.number
        previous = self._last_loss.pop(view, None)
        self._last_loss[view] = loss
        if len(self._last_loss) > _MAX_VIEWS:
            del self._last_loss[next(iter(self._last_loss))]
        if previous is not None:
            change = min(max(math.log(previous / loss), -_MAX_CHANGE), _MAX_CHANGE)
            self._visits = min(self._visits + 1, _HORIZON_VISITS)
            self._improvement += (change - self._improvement) / self._visits

    def releases_next(self) -> bool:
        """True if the next active iteration is released. Call it once per active iteration; shares add up exactly."""
        self._credit += self.released_share  # a sum in place of a random draw: shares add up exactly
        released = self._credit >= 1.0
        self._credit -= float(released)
        return released

    def state(self) -> State:
        """Return the last losses, in the order of the visits, and the running mean."""
        return {
            "views": int_array(*self._last_loss),
            "losses": np.array(list(self._last_loss.values()), np.float64),
            "mean": np.array([self._improvement, self._credit]),
            "visits": int_array(self._visits),
        }

    def restore(self, state: State) -> None:
        """Continue from another measurement's state. Raises MapFileError."""
        views = get_array(state, "views", (None,), np.int64)
        losses = get_floats(state, "losses", len(views))
        if len(views) > _MAX_VIEWS or not all(loss > 0 for loss in losses):
            raise MapFileError(f"state saturation: expected at most {_MAX_VIEWS} losses above 0, got others")
        self._last_loss = dict(zip(views.tolist(), losses, strict=True))
        self._improvement, self._credit = get_floats(state, "mean", 2)
        [self._visits] = get_counts(state, "visits", 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Binding:
    """The arrays that the rasterizer trains on until rows move: Adam's tables and the active phase's rows."""

    tables: _Tables
    active_ids: UInt32[ndarray, " m"] | None
    kappa_counter: UpdateCounter

    @classmethod
    def of(cls, table: SplatTable, active_only: bool) -> _Binding:
        """Return the binding of all rows, valid until the table grows or shrinks. Kappa counts active Gaussians."""
        return cls(
            tables=(table.rows, table.first_moment, table.second_moment),
            active_ids=np.flatnonzero(table.active).astype(np.uint32) if active_only else None,
            kappa_counter=UpdateCounter(table.kappa, table.active),
        )


class Trainer:
    """Runs the training iterations of each mapped frame, and density control after a number of iterations."""

    def __init__(
        self, settings: MapperSettings, table: SplatTable, rasterizer: Rasterizer, rng: np.random.Generator
    ) -> None:
        self._settings = settings
        self._adam, self._loss = settings.optimization.adam, settings.optimization.loss
        rates = ("means", "log_scales", "quats", "opacity_logits", "rgb")
        self._half_size_adam, self._resting_adam = (
            replace(self._adam, **{name: factor * getattr(self._adam, name) for name in rates}) for factor in (0.5, 0.0)
        )
        self._table = table
        self._rasterizer = rasterizer
        self._rng = rng
        self._saturation = RegionSaturation(settings.saturation)
        self._rotations = {stage: ViewRotation() for stage in (Stage.WARM_UP, Stage.ACTIVE)}
        self._active_views = settings.optimization.active_views
        self._iterations = 0
        self._since = {Stage.PRUNING: 0, Stage.DENSIFICATION: 0}

    def state(self) -> State:
        """Return the iteration counts, the measured saturation and the visited views: all state between two frames."""
        return {
            "counts": int_array(self._iterations, *self._since.values()),
            **add_prefix("saturation", self._saturation.state()),
            **add_prefix(Stage.WARM_UP, self._rotations[Stage.WARM_UP].state()),
            **add_prefix(Stage.ACTIVE, self._rotations[Stage.ACTIVE].state()),
        }

    def restore(self, state: State) -> None:
        """Continue from another trainer's state. Raises MapFileError."""
        self._iterations, *since = get_counts(state, "counts", 3)
        self._since = dict(zip(self._since, since, strict=True))
        self._saturation.restore(select_prefix(state, "saturation"))
        for stage, rotation in self._rotations.items():
            rotation.restore(select_prefix(state, stage))

    def reset_roi(self) -> None:
        """Forget how far the region has been trained: a new task has another region."""
        self._saturation.reset()

    def train(self, views: Sequence[WindowView], extent_m: float, scheduler: StageScheduler) -> int:
        """Train on these views while the scheduler allows, and return the number of iterations.

        Warm-up and active iterations alternate in the ratio of the settings, warm-up first. Warm-up iterations replace
        the active ones that a saturated region releases. An active iteration replaces a warm-up iteration for which the
        frame has no time, if it has time for the active one.
        """
        self._adopt_loaded(views)
        turns = self._turns(views)
        done, frame_is_done = 0, False
        while not frame_is_done:
            done, frame_is_done = self._iterate_until_density_control(turns, done, scheduler)
            self._control_density(extent_m, scheduler)
        with scheduler.timing(Stage.FINALISATION):
            self._table.clip_colours(*_COLOUR_RANGE)
            if self._settings.optimization.isotropic:
                self._table.make_isotropic()
            self._update_ema()
        return done

    def idle_step(self, views: Sequence[WindowView], extent_m: float) -> None:
        """Run one iteration on earlier views while no frame waits; warm-up and active iterations alternate."""
        self._adopt_loaded(views)
        turns, scheduler = self._turns(views), CountedScheduler()
        stage = self._next_stage(self._iterations, Stage.ACTIVE in turns, scheduler)
        if stage is None:
            return
        binding = _Binding.of(self._table, self._settings.optimization.active_only)
        with self._rasterizer.bind_tables(*binding.tables):
            self._iterate(binding, stage, turns[stage])
        self._control_density(extent_m, scheduler)
        self._table.clip_colours(*_COLOUR_RANGE)
        if self._iterations % self._settings.optimization.iterations == 0:
            self._update_ema()

    def retrain(self, views: Sequence[WindowView], extent_m: float, scheduler: StageScheduler) -> int:
        """Run an iteration for each of these views while the scheduler has time; return how many."""
        done = 0
        while done < len(views) and scheduler.has_time_for(Stage.WARM_UP):
            self.idle_step(views, extent_m)
            done += 1
        return done

    def _adopt_loaded(self, views: Sequence[WindowView]) -> None:
        """Give new Gaussians of other maps the moments of this map's own, or those that the newest view measures.

        Without moments, Adam's first steps have full length whatever the gradient: one frame ruins a finished map. So
        do dozens of steps on the first view, which an iteration with few views repeats on a new map.
        """
        table, self._active_views = self._table, self._settings.optimization.active_views
        is_loaded, counts = table.anchor == NO_ANCHOR, table.update_counts
        if not is_loaded.any():
            return
        self._active_views = min(self._active_views, sum(view.shows_roi for view in views))
        new = np.flatnonzero(is_loaded & (counts == 0))
        if len(new) > 0 and not counts.any():
            binding = _Binding.of(table, self._settings.optimization.active_only)
            with self._rasterizer.bind_tables(*binding.tables):
                self._train_image(binding, views[-1], self._resting_adam)
        table.adopt(new, _LOADED_UPDATES, self._adam.beta2)

    def _turns(self, views: Sequence[WindowView]) -> dict[Stage, Iterator[WindowView]]:
        """Return the views of each phase in the order of training (MVO), without end.

        The active phase has those that show the ROI. Without the ROI component all iterations are warm-up.
        """
        views_of = {Stage.WARM_UP: list(views)}
        if self._settings.components.roi and self._settings.optimization.active_iterations > 0:
            # others would give the region no gradient
            views_of[Stage.ACTIVE] = [view for view in views if view.shows_roi]
        if self._settings.keyframes.rotates:
            return {stage: self._rotations[stage].turns(chosen) for stage, chosen in views_of.items() if chosen}
        return {stage: _drawn(chosen, self._rng) for stage, chosen in views_of.items() if chosen}

    def _next_stage(self, done: int, roi_in_view: bool, scheduler: StageScheduler) -> Stage | None:
        """Return the stage of the next iteration, after `done` ones; None ends the frame."""
        optimization = self._settings.optimization
        per_frame = optimization.iterations
        # whole images first: they keep the background in place
        warm_up = not roi_in_view or done % per_frame < optimization.warmup_iterations
        warm_up = warm_up or self._saturation.releases_next()  # the whole image gains more than the region loses
        if warm_up and roi_in_view and done > 0:
            # if there is time for neither, the one that is due runs: active iterations may cost as much
            warm_up = scheduler.has_time_for(Stage.WARM_UP) or not scheduler.has_time_for(Stage.ACTIVE)
        if warm_up and scheduler.trains_on(Stage.WARM_UP, per_frame):
            return Stage.WARM_UP
        return Stage.ACTIVE if roi_in_view and scheduler.trains_on(Stage.ACTIVE, per_frame) else None

    def _iterate_until_density_control(
        self, turns: Mapping[Stage, Iterator[WindowView]], done: int, scheduler: StageScheduler
    ) -> tuple[int, bool]:
        """Iterate until density control is due or the frame ends; return `done` and whether the frame ended.

        The rasterizer holds the tables meanwhile; rows move only in density control.
        """
        binding = _Binding.of(self._table, self._settings.optimization.active_only)
        with self._rasterizer.bind_tables(*binding.tables):
            while (stage := self._next_stage(done, Stage.ACTIVE in turns, scheduler)) is not None:
                with scheduler.timing(stage):
                    self._iterate(binding, stage, turns[stage])
                done += 1
                if any(self._is_due(due, scheduler) for due in self._since):
                    return done, False
        return done, True

    def _iterate(self, binding: _Binding, stage: Stage, turns: Iterator[WindowView]) -> None:
        """Run one iteration: on whole images, or on the region in as many views as fit in the tiles of one image."""
        if stage is Stage.WARM_UP:
            self._train_full_images(binding, turns)
        else:
            images = 0.0
            for _ in range(self._active_views):
                view = next(turns)
                self._train_roi(binding, view)
                images += view.roi_share
                if images + view.roi_share > 1.0:  # no more tiles than one image: an iteration has one cost
                    break
        self._iterations += 1
        self._since = {due: iterations + 1 for due, iterations in self._since.items()}

    def _train_full_images(self, binding: _Binding, turns: Iterator[WindowView]) -> None:
        """Train a view in full size, or four in half size: as many pixels.

        The four steps have half the rates: with full ones, scales of the background grow to metres in places.
        """
        for _ in range(_HALF_SIZE_VIEWS):
            view = next(turns)
            self._train_image(binding, view, self._half_size_adam if view.is_half_size else self._adam)
            if not view.is_half_size:
                break

    def _train_image(self, binding: _Binding, view: WindowView, adam: AdamSettings) -> None:
        is_masked = view.keyframe.frame.left_out is not None
        self._rasterizer.step(*binding.tables, view.image_view, view.T_camera_world, self._loss, adam, masked=is_masked)

    def _train_roi(self, binding: _Binding, view: WindowView) -> None:
        report = self._rasterizer.step(
            *binding.tables,
            view.training_view,
            view.T_camera_world,
            self._loss,
            self._adam,
            masked=True,
            subset=view.roi if binding.active_ids is None else Subset(view.roi.tiles, binding.active_ids),
            update_counter=binding.kappa_counter,  # κ: only here, in the active phase
        )
        if self._saturation.enabled:
            self._saturation.observe(view.keyframe.frame.id, report.loss)
        # not once a frame: views train in turn, and frames often end with the same one, which alone would be averaged
        self._update_ema(report.visible)

    def _update_ema(self, rows: UInt32[ndarray, " m"] | None = None) -> None:
        if self._settings.optimization.ema_updates > 0:
            self._table.update_ema(self._settings.optimization.ema_updates, rows)

    def _is_due(self, stage: Stage, scheduler: StageScheduler) -> bool:
        """True after the stage's interval; a frame without time may postpone it to twice the interval."""
        density, iterations = self._settings.density, self._since[stage]
        interval = density.prune_every if stage is Stage.PRUNING else density.densify_every
        return iterations >= 2 * interval or (iterations >= interval and scheduler.has_time_for(stage))

    def _control_density(self, extent_m: float, scheduler: StageScheduler) -> None:
        """Clone, split and prune if due (Sec. III-D.2)."""
        if self._is_due(Stage.PRUNING, scheduler):
            with scheduler.timing(Stage.PRUNING):
                prune(self._table, self._settings.density)
            self._since[Stage.PRUNING] = 0
        if self._is_due(Stage.DENSIFICATION, scheduler):
            with scheduler.timing(Stage.DENSIFICATION):
                densify(self._table, self._settings.density, extent_m)
            self._since[Stage.DENSIFICATION] = 0


def _drawn(views: Sequence[WindowView], rng: np.random.Generator) -> Iterator[WindowView]:
    """Yield uniformly drawn views without end."""
    while True:
        yield views[int(rng.integers(len(views)))]
