"""Map one robot's frames: seed Gaussians by relevance (Sec. III-C), then train them by relevance (Sec. III-D)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import (
    State,
    add_prefix,
    generator_state,
    get_array,
    get_counts,
    get_floats,
    int_array,
    restore_generator,
    select_prefix,
)
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.mapping.anchors import move_with_anchors
from gausslite.mapping.free_space import contradicted_rows, rows_moved_away
from gausslite.mapping.keyframe_store import KeyframeStore
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.moving import MOTION_REFERENCES, moving_pixels
from gausslite.mapping.pager import MapPager
from gausslite.mapping.pose_corrector import PoseCorrector
from gausslite.mapping.pose_estimation import RefinementSettings, open_refiner
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.seeding import Seeder, SeedingContext, Seeds, insert_seeds
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.mapping.stages import SkippableStage, Stage, StageScheduler
from gausslite.mapping.task_change import add_roi_evidence, clear_roi, update_roi_evidence
from gausslite.mapping.training import Trainer
from gausslite.mapping.voxel_exchange import InsertedVoxels, insert_team_voxels
from gausslite.mapping.window_view import WindowView, window_view
from gausslite.render.rasterizer import Rasterizer, Rendering

_MAX_KEYFRAMES = 2**31 - 1
_Pose: TypeAlias = Float64[ndarray, "4 4"]
_STAYS = np.eye(4)
_CORRECTED = "T_corrected_odometry"
_EXTENT_PER_DEPTH = 1.0 / 3.0
"""Scene extent as a fraction of the largest depth so far, as in SplaTAM's released configuration."""


@dataclass(frozen=True, slots=True)
class MappedFrame:
    """Result of mapping one frame."""

    index: int
    seeded: int  # Gaussians added by seeding
    iterations: int  # of training
    gaussians: int  # in the map afterwards
    skipped: str | None = None  # why the frame was not mapped, or None
    T_world_camera: Float64[ndarray, "4 4"] | None = None  # the pose that it was mapped with; None if skipped
    anchor: int = 0  # number of the keyframe that it follows
    T_corrected_earlier: Float64[ndarray, "k 4 4"] | None = None  # motion of each keyframe, world axes, by a loop


@dataclass(frozen=True, slots=True, eq=False)
class FrameView:
    """A frame to map, and what the map shows from its pose."""

    frame: Frame
    rendered: Rendering | None = None  # None if the map is empty or was not rendered


class GaussianMapper:
    """Owner of one growing Gaussian map. Not thread-safe.

    table: the Gaussians. poses: of all mapped frames. store: the keyframes. corrector: of loops, or None. revision:
    number of frames that changed the map.

    Equal settings, seed and frames give bit-identical maps if the rasterizer is deterministic.
    """

    def __init__(
        self,
        settings: MapperSettings,
        rasterizer: Rasterizer,
        seed: int = 0,
        initial_map: Gaussians | None = None,
        corrector: PoseCorrector | None = None,
        pager: MapPager | None = None,
    ) -> None:
        """Allocate memory for `settings.max_gaussians` Gaussians; seed initialises all random choices.

        initial_map: see `continue_map`. Without a corrector, poses are only refined; without a pager, all is in memory.
        """
        self.settings = settings
        self.rasterizer = rasterizer
        self._rng = np.random.default_rng(seed)
        self.table = SplatTable(settings.max_gaussians)
        self.pager = pager or MapPager()
        self._has_prior = False
        if initial_map is not None:
            self.continue_map(initial_map)
        self._seeder = Seeder(settings.seeding, settings.components, self._rng)
        self.store = KeyframeStore(settings.keyframes)
        refinement = RefinementSettings(
            settings.pose_prior, settings.keyframes.pose_updates_per_frame, settings.pose_anchor_share
        )
        self.poses = PoseTable()
        self._refiner = open_refiner(refinement, self._render, self.poses)
        self._trainer = Trainer(settings, self.table, rasterizer, self._rng)
        self.corrector = corrector
        self._extent_m = 0.0
        self.revision = 0
        self._skipped = 0

    @property
    def count(self) -> int:
        """Number of Gaussians in memory and on disk."""
        return self.table.count + self.pager.count

    def continue_map(self, earlier: Gaussians) -> None:
        """Add an earlier map. Keyframes that see through it remove its Gaussians; those that show it set active flags.

        Raises QuotaError if it exceeds the cap.
        """
        self.table.append(earlier)
        self._has_prior = True

    def begin_another(self) -> GaussianMapper:
        """Return an empty map with the same settings, for as many Gaussians as still fit into this one."""
        settings = replace(self.settings, max_gaussians=max(self.table.free_slots, 1))
        corrector = None if self.corrector is None else self.corrector.begin_another()
        return GaussianMapper(settings, self.rasterizer, corrector=corrector)

    def look(self, frame: Frame, scheduler: StageScheduler) -> FrameView:
        """Return the frame with the map rendered from its pose, unless the scheduler skips seeding."""
        self.pager.prepare(self.table, frame, self.store.window)
        if self.table.count == 0 or scheduler.skips(SkippableStage.SEEDING):
            return FrameView(frame)
        with scheduler.timing(Stage.RENDERING):
            return FrameView(frame, self._render(frame.camera, frame.T_world_camera, frame.motion))

    def leave_out_moving(self, view: FrameView, scheduler: StageScheduler) -> FrameView:
        """Return the view without the things that move; a keyframe loses what has moved since."""
        count, moving = self.table.count, self._find_moving(view.frame)
        if view.rendered is None or self.table.count != count:
            view = self.look(view.frame, scheduler)
        return view if moving is None else replace(view, frame=view.frame.without(moving))

    def map_view(self, looked: FrameView, relevance: RelevanceMap, scheduler: StageScheduler) -> MappedFrame:
        """Seed and train the map with one frame; the scheduler limits the time.

        relevance: w(u, v) of Sec. III-B. A frame with a defect is skipped. Raises ShapeError if relevance and frame
        differ in size.
        """
        frame = looked.frame
        require_array("relevance pixel_weights", relevance.pixel_weights, frame.depth_m.shape, np.float32)
        if defect := frame.defect:
            self._skipped += 1
            return MappedFrame(frame.index, 0, 0, self.count, defect)
        is_keyframe = self.store.next_is_keyframe
        self.poses.add(frame, self.store.next_anchor)
        self._refine_keyframes(scheduler)  # earlier poses first: the map has been trained since
        view = self._prepare_view(frame, relevance, scheduler)  # the paper's poses are exact, a robot's are not
        seeded = self._seed(view.keyframe, looked.rendered, scheduler)  # N seeds: SB, SIS with Eq. (1), GFD
        motions = self._close_loop(frame, view.keyframe, scheduler) if is_keyframe else None
        if motions is not None:  # before training, which would pull the map to the wrong place
            view = self._window_view(view.keyframe.moved(motions))
            self.pager.prepare(self.table, view.keyframe.frame, self.store.window)
        iterations = self._train(view, motions, scheduler)  # ROI and MVO with Eq. (2); counts kappa
        self.store.add(view)  # only now: the window has the current view besides
        self.store.keep_images(self.pager.keep)
        if self._has_prior and is_keyframe:
            self._update_prior(view.keyframe)
        self.revision += 1
        return MappedFrame(
            frame.index,
            seeded,
            iterations,
            self.count,
            T_world_camera=view.keyframe.frame.T_world_camera,
            anchor=view.keyframe.anchor,
            T_corrected_earlier=motions,
        )

    def idle_step(self) -> bool:
        """Run one iteration on the window's keyframes. Return False if there are none yet."""
        window = self.pager.trainable(self.store.window)
        if not window:
            return False
        self._trainer.idle_step(window, self._extent_m)
        return True

    def retrain(self, scheduler: StageScheduler) -> None:
        """Train the window's views once more while there is time."""
        self._trainer.retrain(self.pager.trainable(self.store.window), self._extent_m, scheduler)

    def reset_roi(self) -> None:
        """Start a new task: no Gaussian is active, and no keyframe is evaluated.

        The map, kappa and the optimiser state stay; the old ROI is evicted first if the cap is reached.
        """
        self.pager.reset_roi()
        clear_roi(self.table)  # kappa stays: trained voxels keep their weight in the vote
        self.store.reset_roi()
        self._trainer.reset_roi()

    def evaluate_keyframe(self, keyframe: Keyframe, relevance: RelevanceMap | None) -> int:
        """Apply an earlier keyframe's relevance to the present task; return the number of Gaussians seeded.

        Gaussians that the keyframe shows inside the ROI become active. ROI pixels with too few of them are seeded,
        within the cap. None: the relevance cannot be found; the keyframe shows no ROI and adds no evidence.
        """
        if keyframe.evaluated and relevance is not None:  # a late detection: the frame has given its evidence before
            self.store.replace(keyframe.with_relevance(relevance), self._window_view)
            return 0
        if relevance is None:
            self.store.replace(keyframe.with_relevance(keyframe.relevance), None)
            return 0
        require_array("relevance pixel_weights", relevance.pixel_weights, keyframe.frame.depth_m.shape, np.float32)
        table, evaluated = self.table, keyframe.with_relevance(relevance)
        self.store.replace_relevance(evaluated, self._window_view)
        self.pager.show(table, keyframe.frame.camera, keyframe.frame.T_world_camera)
        # earlier Gaussians first: seeds fill only the rest
        update_roi_evidence(table, evaluated.frame, evaluated.relevance)
        if not evaluated.relevance.roi.any():
            return 0
        seeds = self._seeder.seed_roi(evaluated.frame, evaluated.relevance, table.means_m[table.active])
        return self._insert(Seeds(seeds, Gaussians.empty(), keyframe.anchor))

    def complete_keyframe(self, keyframe: Keyframe, relevance: RelevanceMap) -> int:
        """Apply the relevance of a keyframe with objects that became known since; return the number of seeds.

        Gaussians that it shows on the added pixels become active, unless as many completed keyframes show them outside.
        """
        require_array("relevance pixel_weights", relevance.pixel_weights, keyframe.frame.depth_m.shape, np.float32)
        completed = keyframe.with_relevance(relevance)
        added = completed.relevance.without(keyframe.relevance.roi)  # what it showed before has given its evidence
        if not added.roi.any():
            self.store.replace(completed, None)
            return 0
        self.store.replace_relevance(completed, self._window_view)
        self.pager.show(self.table, keyframe.frame.camera, keyframe.frame.T_world_camera)
        add_roi_evidence(self.table, keyframe.frame, completed.relevance, added)
        seeds = self._seeder.seed_roi(keyframe.frame, added, self.table.means_m[self.table.active])
        return self._insert(Seeds(seeds, Gaussians.empty(), keyframe.anchor))

    def insert_team_voxels(self, received: VoxelBatch, grid: VoxelGrid) -> InsertedVoxels:
        """Insert a teammate's voxels whose Σkappa exceeds the local one; they replace the local Gaussians there."""
        inserted = insert_team_voxels(self.table, self.pager.admit(self.table, received), grid)
        self.revision += inserted.gaussians > 0
        return inserted

    def render(self, camera: Camera, T_world_camera: _Pose, motion: CameraMotion | None = None) -> Rendering:
        """Render the map from a pose, with a moving camera if motion is given."""
        self.pager.show(self.table, camera, T_world_camera)
        return self._render(camera, T_world_camera, motion)

    def _render(self, camera: Camera, T_world_camera: _Pose, motion: CameraMotion | None = None) -> Rendering:
        return self.rasterizer.forward(self.table.rows, camera, inverse(T_world_camera), motion=motion)

    def parts(
        self, active_only: bool = False, unsent_only: bool = False, seen_by: Frame | None = None
    ) -> Iterator[Gaussians]:
        """Yield a copy of the map as physical values, averaged if `OptimizationSettings.ema_updates` is above 0.

        First what is in memory, then each part on disk. unsent_only: without what was published and is on disk;
        seen_by: without what is on disk where this frame's camera does not look.
        """
        rows = np.flatnonzero(self.table.active) if active_only else None
        yield self.table.to_gaussians(rows, use_ema := self.settings.optimization.ema_updates > 0)
        for part in self.pager.stored(use_ema, unsent_only, seen_by):
            yield part.take(part.active) if active_only else part

    def gaussians(self, active_only: bool = False, unsent_only: bool = False) -> Gaussians:
        """Return all of `parts` at once."""
        return Gaussians.concatenate(list(self.parts(active_only, unsent_only)))

    def memory_mib(self) -> dict[str, float]:
        """Return the memory in MiB of the table, of Adam's moments and of the keyframes' images."""
        return {
            "table": self.table.table_bytes / 2**20,
            "optimizer": self.table.optimizer_bytes / 2**20,
            "keyframes": self.store.image_bytes / 2**20,
        }

    def state(self) -> State:
        """Return everything that the next frame depends on, as views that are valid until then."""
        return {
            **add_prefix("table", self.table.state()),
            **add_prefix("pages", self.pager.state()),
            **add_prefix("keyframes", self.store.state()),
            **add_prefix("trainer", self._trainer.state()),
            **add_prefix("refiner", {} if self._refiner is None else self._refiner.state()),
            **add_prefix("refiner/history", self.poses.state()),
            **add_prefix("loops", {} if self.corrector is None else self.corrector.state()),
            **({} if self.poses.T_corrected_odometry is None else {_CORRECTED: self.poses.T_corrected_odometry}),
            "generator": generator_state(self._rng),
            "extent_m": np.array([self._extent_m]),
            "frames": int_array(self.revision, self._skipped, self._has_prior),
        }

    def restore(self, state: State) -> None:
        """Continue from the state of a mapper with the same settings; further frames give bit-identical maps.

        Raises MapFileError if the state is not valid, QuotaError if it exceeds max_gaussians. Do not use the mapper
        after an error.
        """
        self.table.restore(select_prefix(state, "table"))
        self.pager.restore(select_prefix(state, "pages"))
        self.store.restore(select_prefix(state, "keyframes"), self._window_view)
        self.store.keep_images(self.pager.keep)
        self._trainer.restore(select_prefix(state, "trainer"))
        if self._refiner is not None:
            self._refiner.restore(select_prefix(state, "refiner"))
        self.poses.restore(select_prefix(state, "refiner/history"))
        if self.corrector is not None:
            self.corrector.restore(select_prefix(state, "loops"))
        if _CORRECTED in state:
            self.poses.T_corrected_odometry = get_array(state, _CORRECTED, (4, 4), np.float64).copy()
        restore_generator(self._rng, get_array(state, "generator", (6,), np.uint64))
        [self._extent_m] = get_floats(state, "extent_m", 1)
        self.revision, self._skipped, has_prior = get_counts(state, "frames", 3)
        self._has_prior = bool(has_prior)
        self._require_known_anchors()

    def _require_known_anchors(self) -> None:
        """Raise MapFileError if a restored Gaussian, keyframe or pose follows an unknown keyframe."""
        count = self.store.count
        anchors = [keyframe.anchor for keyframe in self.store.kept]
        newest = max([int(self.table.anchor.max(initial=NO_ANCHOR)), self.poses.newest_anchor, *anchors])
        if newest >= count or self.table.anchor.min(initial=0) < NO_ANCHOR or count > _MAX_KEYFRAMES:
            raise MapFileError(f"state anchors: expected the numbers of {count} keyframes, got others")
        if self.corrector is not None and self.corrector.keyframes != count:
            raise MapFileError(f"state loops: expected {count} keyframes, got {self.corrector.keyframes}")

    def _prepare_view(self, frame: Frame, relevance: RelevanceMap, scheduler: StageScheduler) -> WindowView:
        """Prepare the frame for training; refine its pose and exposure if the prior allows an error."""
        with scheduler.timing(Stage.VIEW_PREPARATION):
            # beyond max_depth_m nothing is seeded, and one outlier would enlarge the extent for the whole mission
            largest_depth_m = min(float(frame.depth_m.max()), self.settings.seeding.max_depth_m)
            self._extent_m = max(self._extent_m, largest_depth_m * _EXTENT_PER_DEPTH)
            keyframe = Keyframe(frame, relevance, anchor=self.store.next_anchor).with_relevance(relevance)
            if self._refiner is not None and self.table.count:
                keyframe = replace(keyframe, frame=self._refiner.refine(frame), recorded=frame)
            self.poses.refine(frame.id, keyframe.frame.T_world_camera)
            return self._window_view(keyframe)

    def _refine_keyframes(self, scheduler: StageScheduler) -> None:
        """Refine the next keyframes against the map, while there is time and the prior allows an error."""
        if self._refiner is None or self.table.count == 0:
            return
        for keyframe in self._refiner.next_keyframes(self.pager.trainable(self.store.window)):
            if not scheduler.has_time_for(Stage.KEYFRAME_REFINEMENT):
                return
            with scheduler.timing(Stage.KEYFRAME_REFINEMENT):
                self.store.replace(self._refiner.refine_keyframe(keyframe), self._window_view)

    def _find_moving(self, frame: Frame) -> Bool[ndarray, "h w"] | None:
        """Return the pixels of things that move, None without any; leave out of a keyframe what has moved since."""
        keyframes = self.store.kept[-MOTION_REFERENCES:] if self.settings.leaves_out_moving else ()
        frames = [keyframe.frame for keyframe in keyframes]
        if keyframes:
            # one keyframe with each frame
            chosen = self.revision % len(keyframes)
            later = [*frames[chosen + 1 :], frame]
            moved = moving_pixels(frames[chosen], later)
            if moved.any():
                contradicting = [*frames[:chosen], *later]
                # they show where the thing was
                self.table.remove(rows_moved_away(self.table.means_m, frames[chosen], moved, contradicting))
                self.store.replace(keyframes[chosen].without(moved), self._window_view)
        moving = moving_pixels(frame, frames)
        return moving if moving.any() else None

    def _close_loop(
        self, prior: Frame, keyframe: Keyframe, scheduler: StageScheduler
    ) -> Float64[ndarray, "k 4 4"] | None:
        """Search a loop of a new keyframe; if it corrects poses, move Gaussians, keyframes and poses with them.

        prior: the frame with the pose before refinement.
        """
        if self.corrector is None:
            return None
        search = scheduler.has_time_for(Stage.LOOP_CLOSURE)
        with scheduler.timing(Stage.LOOP_CLOSURE):
            self.pager.show(self.table, keyframe.frame.camera, keyframe.frame.T_world_camera)  # what a drift hides
            motions = self.corrector.add(keyframe, prior, self.store.kept if search else (), self.table)
            if motions is None:
                return None
            self.pager.move(motions)
            move_with_anchors(self.table, motions)  # map, keyframes and poses move together
            self.store.move(motions)
            self.poses.move(motions)
            return motions

    def _window_view(self, keyframe: Keyframe) -> WindowView:
        return window_view(keyframe, self.rasterizer, self.settings.keyframes)

    def _seed(self, keyframe: Keyframe, rendered: Rendering | None, scheduler: StageScheduler) -> int:
        """Add Gaussians where the map does not explain the frame (Sec. III-C); return how many."""
        if scheduler.skips(SkippableStage.SEEDING):
            return 0
        frame, table = keyframe.frame, self.table
        # rendered from the pose before refinement
        if (rendered is None or keyframe.recorded is not None) and table.count:
            rendered = self._render(frame.camera, frame.T_world_camera, frame.motion)
        with scheduler.timing(Stage.SEEDING):
            share = self.settings.seeding.background_share
            max_active = round((1.0 - share) * table.capacity) if share > 0 else None
            context = SeedingContext(table.free_slots, rendered, table.means_m[table.active], max_active)
            seeds = self._seeder.seed(frame, keyframe.relevance, context)
            return self._insert(replace(seeds, anchor=keyframe.anchor))

    def _update_prior(self, keyframe: Keyframe) -> None:
        """Set the active flags of what a keyframe shows, and remove the Gaussians that the keyframes see through."""
        update_roi_evidence(self.table, keyframe.frame, keyframe.relevance)
        frames = (earlier.frame for earlier in self.store.buffer)
        self.table.remove(contradicted_rows(self.table.means_m, keyframe.frame, frames))

    def _insert(self, seeds: Seeds) -> int:
        """Add seeds within the cap; return how many."""
        seeding, table = self.settings.seeding, self.table
        min_background = int(seeding.background_share * table.capacity)
        return insert_seeds(table, seeds, seeding.opacity, self._rng, min_background)

    def _train(self, current: WindowView, motions: Float64[ndarray, "k 4 4"] | None, scheduler: StageScheduler) -> int:
        """Train on the window and the current view (MVO, Sec. III-D.2); without MVO on the current view alone.

        motions: of the keyframes by a loop, or None. The views that it moved train once more, because the map was
        trained from other poses.
        """
        window = self.pager.trainable(self.store.window)
        views = (*window, current) if self.settings.components.mvo else (current,)
        done = self._trainer.train(views, self._extent_m, scheduler)
        moved = [] if motions is None else [view for view in window if (motions[view.keyframe.anchor] != _STAYS).any()]
        return done + self._trainer.retrain(moved, self._extent_m, scheduler)
