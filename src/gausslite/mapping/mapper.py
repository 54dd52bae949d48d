"""Grow one robot's map frame by frame: seed where it is missing, train where the task needs it (Sec. III-C, III-D)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, get_floats, int_array, select_prefix
from gausslite.mapping.checkpoint import generator_state, set_generator
from gausslite.mapping.coverage import RenderedView
from gausslite.mapping.eviction import insert
from gausslite.mapping.keyframes import Keyframe, KeyframeStore, WindowView, window_view
from gausslite.mapping.seeding import Seeder, SeedingContext, Seeds
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.stages import CountedScheduler, SkippableStage, Stage, StageScheduler
from gausslite.mapping.task_change import clear_roi, vote_on_relevance
from gausslite.mapping.training import Trainer
from gausslite.mapping.view_refinement import ViewRefiner
from gausslite.optimize.parameters import SplatTable
from gausslite.render.rasterizer import Rasterizer, Rendering

_EXTENT_PER_DEPTH = 1.0 / 3.0
"""The scene's extent as a fraction of the farthest depth seen, as SplaTAM's released configuration takes it."""


@dataclass(frozen=True, slots=True)
class MappedFrame:
    """What mapping one frame did; skipped says why nothing was done, and is None otherwise."""

    index: int
    seeded: int
    iterations: int
    gaussians: int
    skipped: str | None = None


class GaussianMapper:
    """The owner of a growing map. Not thread-safe: one worker calls it.

    The same settings, seed and frames give the same map, as far as the rasterizer is deterministic.
    """

    def __init__(
        self, settings: MapperSettings, rasterizer: Rasterizer, seed: int = 0, known: Gaussians | None = None
    ) -> None:
        """Reserve the memory of `settings.max_gaussians` Gaussians; seed starts all random choices.

        known is a map to start from. Raises QuotaError when it exceeds the settings' cap.
        """
        self._settings = settings
        self._rasterizer = rasterizer
        self._rng = np.random.default_rng(seed)
        self._table = SplatTable(settings.max_gaussians)
        if known is not None:
            self._table.append(known)
        self._seeder = Seeder(settings.seeding, settings.components, self._rng)
        self._keyframes = KeyframeStore(settings.keyframes, settings.components.follow_task)
        self._refiner = ViewRefiner(settings.pose_prior, self.render, settings.keyframes.pose_updates_per_frame)
        self._trainer = Trainer(settings, self._table, rasterizer, self._rng)
        self._extent_m = 0.0
        self._revision = 0
        self._skipped = 0

    @property
    def count(self) -> int:
        """Gaussians in the map."""
        return self._table.count

    @property
    def revision(self) -> int:
        """Rises by one with every frame that changed the map."""
        return self._revision

    @property
    def skipped(self) -> int:
        """Frames that could not be mapped."""
        return self._skipped

    @property
    def settings(self) -> MapperSettings:
        """The policy in force."""
        return self._settings

    def map_frame(
        self,
        frame: Frame,
        relevance: RelevanceMap,
        scheduler: StageScheduler | None = None,
        sight: RenderedView | None = None,
    ) -> MappedFrame:
        """Take one frame into the map, in the time that the scheduler gives; by default iterations are counted.

        sight is how the map looks from the frame, drawn here unless it is given and the frame's pose is trusted. A
        frame without a depth reading is skipped and counted. Raises ShapeError when relevance and frame differ in size.
        """
        require_array("relevance weight", relevance.weight, frame.depth_m.shape, np.float32)
        scheduler = CountedScheduler() if scheduler is None else scheduler
        if not frame.has_depth:
            self._skipped += 1
            return MappedFrame(frame.index, 0, 0, self.count, "no pixel has a depth reading")
        with scheduler.timing(Stage.VIEW_PREPARATION):
            view = self._observe(frame, relevance)
        seeded = 0 if scheduler.skips(SkippableStage.SEEDING) else self._seed(view.keyframe, sight, scheduler)
        iterations = self._train(view, scheduler)
        self._keyframes.offer(view)
        self._revision += 1
        return MappedFrame(frame.index, seeded, iterations, self.count)

    def idle_step(self) -> bool:
        """One more iteration on the window's keyframes; False when there are none yet."""
        if not self._keyframes.window:
            return False
        self._trainer.idle_step(self._keyframes.window, self._extent_m)
        return True

    def update_relevance(self, frame: Frame, relevance: RelevanceMap) -> bool:
        """Take what came to be known of an earlier frame; False when it is no keyframe of the window (any more)."""
        view = self._keyframes.of(frame)
        if view is None:
            return False
        if view.keyframe.evaluated:
            self._keyframes.replace_view(self._view(replace(view.keyframe, relevance=relevance)))
        else:
            self.evaluate_keyframe(view.keyframe, relevance)
        return True

    def reset_roi(self) -> None:
        """Map for another task from now on: nothing counts as its region until keyframes are evaluated for it.

        The map, kappa and the optimiser's state stay; what was the old region gives way first when room is short.
        """
        clear_roi(self._table)
        self._keyframes.reset_roi()

    @property
    def next_unevaluated(self) -> Keyframe | None:
        """The newest keyframe whose relevance to the present task is not known; None when all are evaluated."""
        return self._keyframes.next_unevaluated

    def evaluate_keyframe(self, keyframe: Keyframe, relevance: RelevanceMap) -> int:
        """Take what of an earlier keyframe is relevant to the present task; returns how many Gaussians were seeded.

        What it shows of the region becomes active, and is seeded where the map is too coarse for it, within the cap.
        """
        require_array("relevance weight", relevance.weight, keyframe.frame.depth_m.shape, np.float32)
        frame, table = keyframe.frame, self._table
        self._keyframes.evaluate(replace(keyframe, relevance=relevance, evaluated=True), self._view)
        vote_on_relevance(table, frame, relevance)
        if not relevance.roi.any():
            return 0
        seeds = self._seeder.seed_region(frame, relevance, table.means_m[table.active])
        return self._insert(Seeds(seeds, Gaussians.empty()))

    def mark_unavailable(self, keyframe: Keyframe) -> None:
        """What of an earlier keyframe is relevant to the present task will not be known: it shows no region, and casts
        no votes either.
        """
        self._keyframes.evaluate(replace(keyframe, evaluated=True), self._view)

    def render_view(self, frame: Frame) -> RenderedView | None:
        """How the map looks from a frame; None while it is empty."""
        return RenderedView.of(self.render(frame.camera, frame.T_world_camera)) if self.count > 0 else None

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Rendering:
        """Draw the map from a pose."""
        return self._rasterizer.forward(self._table.rows, camera, inverse(T_world_camera))

    def gaussians(self) -> Gaussians:
        """A copy of the map as physical values, as it is shown (`OptimizationSettings.ema_updates`)."""
        return self._table.to_gaussians(use_ema=self._settings.optimization.ema_updates > 0)

    def roi_gaussians(self) -> Gaussians:
        """A copy of the active Gaussians: the task's part of the map."""
        averaged = self._settings.optimization.ema_updates > 0
        return self._table.to_gaussians(np.flatnonzero(self._table.active), averaged)

    def keyframes(self) -> list[Keyframe]:
        """The keyframes remembered of the whole mission, oldest first (for joint refinement)."""
        return list(self._keyframes.buffer)

    def memory_mib(self) -> dict[str, float]:
        """MiB of the table and of Adam's moments, both reserved at the start, and of the keyframes' images."""
        return {
            "table": self._table.table_bytes / 2**20,
            "optimizer": self._table.optimizer_bytes / 2**20,
            "keyframes": self._keyframes.image_bytes / 2**20,
        }

    def state(self) -> State:
        """All that the next frame's mapping depends on, as views; valid until then."""
        return {
            **add_prefix("table", self._table.state()),
            **add_prefix("keyframes", self._keyframes.state()),
            **add_prefix("trainer", self._trainer.state()),
            **add_prefix("refiner", self._refiner.state()),
            "generator": generator_state(self._rng),
            "extent_m": np.array([self._extent_m]),
            "frames": int_array(self._revision, self._skipped),
        }

    def restore(self, state: State) -> None:
        """Go on from what a mapper of the same settings handed out: the next frames give the same bits as there.

        Raises MapFileError for a state that is none, QuotaError for one beyond max_gaussians. After an error this
        mapper must not be used.
        """
        self._table.restore(select_prefix(state, "table"))
        self._keyframes.restore(select_prefix(state, "keyframes"), self._view)
        self._trainer.restore(select_prefix(state, "trainer"))
        self._refiner.restore(select_prefix(state, "refiner"))
        set_generator(self._rng, get_array(state, "generator", (6,), np.uint64))
        [self._extent_m] = get_floats(state, "extent_m", 1)
        self._revision, self._skipped = get_counts(state, "frames", 2)

    def _observe(self, frame: Frame, relevance: RelevanceMap) -> WindowView:
        """Make the frame ready to train on, with its pose and colours refined where they may be wrong."""
        # nothing is seeded farther away, and one stray reading would count for the whole mission
        farthest_m = min(float(frame.depth_m.max()), self._settings.seeding.max_depth_m)
        self._extent_m = max(self._extent_m, farthest_m * _EXTENT_PER_DEPTH)
        if not self._refiner.needed or self._table.count == 0:
            return self._view(Keyframe(frame, relevance))
        self._refine_keyframes()
        return self._view(Keyframe(self._refiner.settle(frame), relevance, recorded=frame))

    def _refine_keyframes(self) -> None:
        """Some keyframes of the window, fitted again to the map as it has become."""
        for view in self._refiner.next_turns(self._keyframes.window):
            self._keyframes.replace_view(self._view(self._refiner.fit_again(view.keyframe)))

    def _view(self, keyframe: Keyframe) -> WindowView:
        return window_view(keyframe, self._rasterizer, self._settings.keyframes)

    def _seed(self, keyframe: Keyframe, sight: RenderedView | None, scheduler: StageScheduler) -> int:
        """Add Gaussians where the map does not explain the frame, within the cap."""
        frame, table = keyframe.frame, self._table
        if sight is None or keyframe.recorded is not None:
            sight = self.render_view(frame)
        with scheduler.timing(Stage.SEEDING):
            state = SeedingContext(table.free_slots, sight, table.means_m[table.active])
            seeds = self._seeder.seed(frame, keyframe.relevance, state)
            return self._insert(seeds)

    def _insert(self, seeds: Seeds) -> int:
        """Add them within the cap; returns how many were added."""
        seeding, table = self._settings.seeding, self._table
        return insert(table, seeds, seeding.opacity, self._rng, int(seeding.background_share * table.capacity))

    def _train(self, current: WindowView, scheduler: StageScheduler) -> int:
        """MVO: train on views drawn from the window and the current one; without it on the current one alone."""
        views = (*self._keyframes.window, current) if self._settings.components.mvo else (current,)
        return self._trainer.train(views, self._extent_m, scheduler)
