"""Map one robot's frames: seed Gaussians by relevance (Sec. III-C), then train them by relevance (Sec. III-D)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame, FrameId
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, orthonormal
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
from gausslite.mapping.free_space import contradicted_rows, guessed_far, left_behind
from gausslite.mapping.keyframes import Keyframe, KeyframeStore, WindowView, window_view
from gausslite.mapping.pose_corrector import LoopCounts, PoseCorrector
from gausslite.mapping.poses import PoseHistory, RefinementSettings, ViewRefiner
from gausslite.mapping.seeding import RenderedView, Seeder, SeedingContext, Seeds, insert_seeds
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.splat_table import NO_ANCHOR, SplatTable
from gausslite.mapping.task_change import add_roi_evidence, clear_roi, update_roi_evidence
from gausslite.mapping.training import CountedScheduler, SkippableStage, Stage, StageScheduler, Trainer
from gausslite.mapping.voxel_exchange import InsertedVoxels, insert_team_voxels
from gausslite.render.rasterizer import Rasterizer, Rendering

_MAX_KEYFRAMES = 2**31 - 1
_STAYS = np.eye(4)
_EXTENT_PER_DEPTH = 1.0 / 3.0
"""Scene extent as a fraction of the largest depth so far, as in SplaTAM's released configuration."""


@dataclass(frozen=True, slots=True)
class MappedFrame:
    """Result of mapping one frame: Gaussians added by seeding, iterations, and Gaussians in the map afterwards.

    skipped: why the frame was not mapped, or None. T_world_camera: the pose that it was mapped with; None if skipped.
    anchor: number of the keyframe that it follows. T_corrected_earlier: motion of each keyframe, in world axes, if a
    loop corrected the map after this frame.
    """

    index: int
    seeded: int
    iterations: int
    gaussians: int
    skipped: str | None = None
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    anchor: int = 0
    T_corrected_earlier: Float64[ndarray, "k 4 4"] | None = None


class GaussianMapper:
    """Owner of one growing Gaussian map. Not thread-safe.

    Equal settings, seed and frames give bit-identical maps if the rasterizer is deterministic.
    """

    def __init__(
        self,
        settings: MapperSettings,
        rasterizer: Rasterizer,
        seed: int = 0,
        initial_map: Gaussians | None = None,
        corrector: PoseCorrector | None = None,
    ) -> None:
        """Allocate memory for `settings.max_gaussians` Gaussians; seed initialises all random choices.

        initial_map: see `continue_map`. Without a corrector, poses are only refined.
        """
        self._settings = settings
        self._rasterizer = rasterizer
        self._rng = np.random.default_rng(seed)
        self._table = SplatTable(settings.max_gaussians)
        self._has_prior = False
        if initial_map is not None:
            self.continue_map(initial_map)
        self._seeder = Seeder(settings.seeding, settings.components, self._rng)
        self._keyframes = KeyframeStore(settings.keyframes)
        refinement = RefinementSettings(
            settings.pose_prior, settings.keyframes.pose_updates_per_frame, settings.pose_anchor_share
        )
        self._refiner = ViewRefiner(refinement, self.render)
        self._trainer = Trainer(settings, self._table, rasterizer, self._rng)
        self._corrector = corrector
        self._T_corrected_odometry: Float64[ndarray, "4 4"] | None = None
        self._extent_m = 0.0
        self._revision = 0
        self._skipped = 0

    def continue_map(self, earlier: Gaussians) -> None:
        """Add an earlier map. Keyframes that see through it remove its Gaussians; those that show it set active flags.

        Raises QuotaError if it exceeds the cap.
        """
        self._table.append(earlier)
        self._has_prior = True

    @property
    def count(self) -> int:
        """Gaussians in the map."""
        return self._table.count

    @property
    def revision(self) -> int:
        """Number of frames that changed the map."""
        return self._revision

    @property
    def skipped(self) -> int:
        """Number of frames with a defect, which are not mapped."""
        return self._skipped

    @property
    def settings(self) -> MapperSettings:
        """Settings of the mapping policy."""
        return self._settings

    def map_frame(
        self,
        frame: Frame,
        relevance: RelevanceMap,
        scheduler: StageScheduler | None = None,
        rendered: RenderedView | None = None,
        odometry: Frame | None = None,
    ) -> MappedFrame:
        """Seed and train the map with one frame; the scheduler limits the time, by default iterations are counted.

        relevance: w(u, v) of Sec. III-B. rendered: the map rendered from frame.T_world_camera; if None, or if the pose
        is refined, the mapper renders it. odometry: the frame with the odometry's pose, if frame has another. A frame
        with a defect is skipped. Raises ShapeError if relevance and frame differ in size.
        """
        require_array("relevance pixel_weights", relevance.pixel_weights, frame.depth_m.shape, np.float32)
        scheduler = CountedScheduler() if scheduler is None else scheduler
        if defect := frame.defect:
            self._skipped += 1
            return MappedFrame(frame.index, 0, 0, self.count, defect)
        self._refiner.history.begin(odometry or frame, self._keyframes.next_anchor)
        self._refine_keyframes(scheduler)
        with scheduler.timing(Stage.VIEW_PREPARATION):
            view = self._prepare_view(frame, relevance)
        self._refiner.history.record(frame, view.keyframe.frame.T_world_camera)
        seeded = 0 if scheduler.skips(SkippableStage.SEEDING) else self._seed(view.keyframe, rendered, scheduler)
        motions = self._close_loop(frame, view.keyframe, scheduler) if self._keyframes.next_is_keyframe else None
        if motions is not None:
            view = self._window_view(view.keyframe.moved(motions))
        iterations = self._train(view, motions, scheduler)
        is_keyframe = self._keyframes.next_is_keyframe
        self._keyframes.add(view)
        if self._has_prior and is_keyframe:
            self._revise(view.keyframe)
        self._revision += 1
        return MappedFrame(
            frame.index,
            seeded,
            iterations,
            self.count,
            T_world_camera=view.keyframe.frame.T_world_camera,
            anchor=view.keyframe.anchor,
            T_corrected_earlier=motions,
        )

    def corrected(self, odometry: Frame) -> Frame:
        """Return the frame with its pose as the loops so far correct it; the frame itself without a correction."""
        T = self._T_corrected_odometry
        return odometry if T is None else replace(odometry, T_world_camera=orthonormal(T @ odometry.T_world_camera))

    @property
    def loops(self) -> LoopCounts:
        """What became of the loops so far."""
        return LoopCounts() if self._corrector is None else self._corrector.counts

    def idle_step(self) -> bool:
        """Run one iteration on the window's keyframes. Return False if there are none yet."""
        if not self._keyframes.window:
            return False
        self._trainer.idle_step(self._keyframes.window, self._extent_m)
        return True

    def update_relevance(self, frame: FrameId, relevance: RelevanceMap) -> None:
        """Replace the relevance of an earlier frame, if its keyframe is still kept."""
        keyframe = self._keyframes.get(frame)
        if keyframe is None:
            return
        if keyframe.evaluated:
            self._keyframes.replace(keyframe.with_relevance(relevance), self._window_view)
        else:
            self.evaluate_keyframe(keyframe, relevance)

    def reset_roi(self) -> None:
        """Start a new task: no Gaussian is active, and no keyframe is evaluated.

        The map, kappa and the optimiser state stay; the old ROI is evicted first if the cap is reached.
        """
        clear_roi(self._table)
        self._keyframes.reset_roi()
        self._trainer.reset_roi()

    @property
    def next_unevaluated(self) -> Keyframe | None:
        """The newest keyframe not evaluated for the present task, or None."""
        return self._keyframes.next_unevaluated

    def evaluate_keyframe(self, keyframe: Keyframe, relevance: RelevanceMap) -> int:
        """Apply an earlier keyframe's relevance to the present task; return the number of Gaussians seeded.

        Gaussians that the keyframe shows inside the ROI become active. ROI pixels with too few of them are seeded,
        within the cap.
        """
        require_array("relevance pixel_weights", relevance.pixel_weights, keyframe.frame.depth_m.shape, np.float32)
        table, evaluated = self._table, keyframe.with_relevance(relevance)
        self._keyframes.replace_relevance(evaluated, self._window_view)
        update_roi_evidence(table, evaluated.frame, evaluated.relevance)
        if not evaluated.relevance.roi.any():
            return 0
        seeds = self._seeder.seed_roi(evaluated.frame, evaluated.relevance, table.means_m[table.active])
        return self._insert(Seeds(seeds, Gaussians.empty(), keyframe.anchor))

    def next_incomplete(self, known_objects: int) -> Keyframe | None:
        """The newest keyframe whose relevance was estimated with fewer known objects, or None."""
        return self._keyframes.next_incomplete(known_objects)

    def complete_keyframe(self, keyframe: Keyframe, relevance: RelevanceMap) -> int:
        """Apply the relevance of a keyframe with objects that became known since; return the number of seeds.

        Gaussians that it shows on the added pixels become active, unless as many completed keyframes show them outside.
        """
        require_array("relevance pixel_weights", relevance.pixel_weights, keyframe.frame.depth_m.shape, np.float32)
        completed = keyframe.with_relevance(relevance)
        added = completed.relevance.without(keyframe.relevance.roi)
        if not added.roi.any():
            self._keyframes.replace(completed, None)
            return 0
        self._keyframes.replace_relevance(completed, self._window_view)
        add_roi_evidence(self._table, keyframe.frame, completed.relevance, added)
        seeds = self._seeder.seed_roi(keyframe.frame, added, self._table.means_m[self._table.active])
        return self._insert(Seeds(seeds, Gaussians.empty(), keyframe.anchor))

    def insert_team_voxels(self, received: VoxelBatch, grid: VoxelGrid) -> InsertedVoxels:
        """Insert a teammate's voxels whose Σkappa exceeds the local one; they replace the local Gaussians there."""
        inserted = insert_team_voxels(self._table, received, grid)
        self._revision += inserted.gaussians > 0
        return inserted

    def mark_unavailable(self, keyframe: Keyframe) -> None:
        """Mark a keyframe as evaluated without a result: it shows no ROI and adds no evidence."""
        self._keyframes.replace_relevance(replace(keyframe, evaluated=True), self._window_view)

    def without(self, pixels: Bool[ndarray, "h w"], frame: Frame) -> Frame:
        """Return the frame without depth in these pixels, and with the map's colours, so that nothing is seeded there.

        The map's own colours give no gradient, so nothing is trained there either.
        """
        rendered = self.render(frame.camera, frame.T_world_camera, frame.motion).rgb
        rgb = np.rint(np.clip(rendered, 0.0, 1.0) * 255.0).astype(np.uint8)
        return replace(
            frame,
            rgb=np.where(pixels[..., None], rgb, frame.rgb),
            depth_m=np.where(pixels, np.float32(0), frame.depth_m),
        )

    def hide(self, moved: Bool[ndarray, "h w"], keyframe: Keyframe, others: Sequence[Frame]) -> None:
        """Take pixels of a keyframe out of training, and remove their Gaussians that the other frames contradict."""
        self._table.remove(left_behind(self._table.means_m, keyframe.frame, moved, others))
        recorded = None if keyframe.recorded is None else self.without(moved, keyframe.recorded)
        hidden = replace(
            keyframe,
            frame=self.without(moved, keyframe.frame),
            recorded=recorded,
            relevance=keyframe.relevance.without(moved),
            hidden=moved if keyframe.hidden is None else keyframe.hidden | moved,
        )
        self._keyframes.replace(hidden, self._window_view)

    def render_view(self, frame: Frame) -> RenderedView | None:
        """Return alpha and depth of the map from a frame's pose; None if the map is empty."""
        if self.count == 0:
            return None
        return RenderedView.from_rendering(self.render(frame.camera, frame.T_world_camera, frame.motion))

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], motion: CameraMotion | None = None
    ) -> Rendering:
        """Render the map from a pose, with a moving camera if motion is given."""
        return self._rasterizer.forward(self._table.rows, camera, inverse(T_world_camera), motion=motion)

    @property
    def poses(self) -> PoseHistory:
        """The poses of all mapped frames: the odometry's, and their latest estimate in the map."""
        return self._refiner.history

    def gaussians(self) -> Gaussians:
        """Return a copy of the map as physical values, averaged if `OptimizationSettings.ema_updates` is above 0."""
        return self._table.to_gaussians(use_ema=self._settings.optimization.ema_updates > 0)

    def roi_gaussians(self) -> Gaussians:
        """Return a copy of the active Gaussians."""
        return self._table.to_gaussians(np.flatnonzero(self._table.active), self._settings.optimization.ema_updates > 0)

    def shared_gaussians(self) -> Gaussians:
        """Return a copy of the map for others: without untrained Gaussians whose distance is a guess of 4 m or more."""
        gaussians = self.gaussians()
        untrained = np.flatnonzero(gaussians.kappa == 0)
        guessed = guessed_far(gaussians.means_m[untrained], (keyframe.frame for keyframe in self._keyframes.kept))
        return gaussians.take(np.delete(np.arange(len(gaussians)), untrained[guessed]))

    def keyframes(self) -> list[Keyframe]:
        """Return the keyframes kept of the whole mission and those that train the map, by capture time (Sec. III-E)."""
        return list(self._keyframes.kept)

    def memory_mib(self) -> dict[str, float]:
        """Return the memory in MiB of the table, of Adam's moments and of the keyframes' images."""
        return {
            "table": self._table.table_bytes / 2**20,
            "optimizer": self._table.optimizer_bytes / 2**20,
            "keyframes": self._keyframes.image_bytes / 2**20,
        }

    def state(self) -> State:
        """Return everything that the next frame depends on, as views that are valid until then."""
        return {
            **add_prefix("table", self._table.state()),
            **add_prefix("keyframes", self._keyframes.state()),
            **add_prefix("trainer", self._trainer.state()),
            **add_prefix("refiner", self._refiner.state()),
            **add_prefix("loops", {} if self._corrector is None else self._corrector.state()),
            **({} if self._T_corrected_odometry is None else {"T_corrected_odometry": self._T_corrected_odometry}),
            "generator": generator_state(self._rng),
            "extent_m": np.array([self._extent_m]),
            "frames": int_array(self._revision, self._skipped, self._has_prior),
        }

    def restore(self, state: State) -> None:
        """Continue from the state of a mapper with the same settings; further frames give bit-identical maps.

        Raises MapFileError if the state is not valid, QuotaError if it exceeds max_gaussians. Do not use the mapper
        after an error.
        """
        self._table.restore(select_prefix(state, "table"))
        self._keyframes.restore(select_prefix(state, "keyframes"), self._window_view)
        self._trainer.restore(select_prefix(state, "trainer"))
        self._refiner.restore(select_prefix(state, "refiner"))
        if self._corrector is not None:
            self._corrector.restore(select_prefix(state, "loops"))
        if "T_corrected_odometry" in state:
            self._T_corrected_odometry = get_array(state, "T_corrected_odometry", (4, 4), np.float64).copy()
        restore_generator(self._rng, get_array(state, "generator", (6,), np.uint64))
        [self._extent_m] = get_floats(state, "extent_m", 1)
        self._revision, self._skipped, has_prior = get_counts(state, "frames", 3)
        self._has_prior = bool(has_prior)
        self._require_known_anchors()

    def _require_known_anchors(self) -> None:
        """Raise MapFileError if a restored Gaussian, keyframe or pose follows an unknown keyframe."""
        count = self._keyframes.count
        anchors = [keyframe.anchor for keyframe in self._keyframes.kept]
        newest = max([int(self._table.anchor.max(initial=NO_ANCHOR)), self.poses.newest_anchor, *anchors])
        if newest >= count or self._table.anchor.min(initial=0) < NO_ANCHOR or count > _MAX_KEYFRAMES:
            raise MapFileError(f"state anchors: expected the numbers of {count} keyframes, got others")
        if self._corrector is not None and self._corrector.keyframes != count:
            raise MapFileError(f"state loops: expected {count} keyframes, got {self._corrector.keyframes}")

    def _prepare_view(self, frame: Frame, relevance: RelevanceMap) -> WindowView:
        """Prepare the frame for training; refine its pose and exposure if the prior allows an error."""
        # beyond max_depth_m nothing is seeded, and one outlier would enlarge the extent for the whole mission
        largest_depth_m = min(float(frame.depth_m.max()), self._settings.seeding.max_depth_m)
        self._extent_m = max(self._extent_m, largest_depth_m * _EXTENT_PER_DEPTH)
        anchor = self._keyframes.next_anchor
        if not self._refiner.enabled or self._table.count == 0:
            return self._window_view(Keyframe(frame, relevance, anchor=anchor))
        return self._window_view(Keyframe(self._refiner.refine(frame), relevance, recorded=frame, anchor=anchor))

    def _refine_keyframes(self, scheduler: StageScheduler) -> None:
        """Refine the next keyframes against the map, while there is time and the prior allows an error."""
        refines = self._refiner.enabled and self._table.count > 0
        for keyframe in self._refiner.next_keyframes(self._keyframes.window) if refines else ():
            if not scheduler.has_time_for(Stage.KEYFRAME_REFINEMENT):
                return
            with scheduler.timing(Stage.KEYFRAME_REFINEMENT):
                self._keyframes.replace(self._refiner.refine_keyframe(keyframe), self._window_view)

    def _close_loop(
        self, prior: Frame, keyframe: Keyframe, scheduler: StageScheduler
    ) -> Float64[ndarray, "k 4 4"] | None:
        """Search a loop of a new keyframe; if it corrects poses, move Gaussians, keyframes and poses with them.

        prior: the frame with the pose before refinement.
        """
        if self._corrector is None:
            return None
        search = scheduler.has_time_for(Stage.LOOP_CLOSURE)
        with scheduler.timing(Stage.LOOP_CLOSURE):
            motions = self._corrector.add(keyframe, prior, self._keyframes.kept if search else (), self._table)
            if motions is None:
                return None
            move_with_anchors(self._table, motions)
            self._keyframes.move(motions)
            self._refiner.history.move(motions)
            T_earlier = np.eye(4) if self._T_corrected_odometry is None else self._T_corrected_odometry
            self._T_corrected_odometry = orthonormal(motions[-1] @ T_earlier)
            return motions

    def _window_view(self, keyframe: Keyframe) -> WindowView:
        return window_view(keyframe, self._rasterizer, self._settings.keyframes)

    def _seed(self, keyframe: Keyframe, rendered: RenderedView | None, scheduler: StageScheduler) -> int:
        """Add Gaussians where the map does not explain the frame (Sec. III-C); return how many."""
        frame, table = keyframe.frame, self._table
        if rendered is None or keyframe.recorded is not None:
            rendered = self.render_view(frame)
        with scheduler.timing(Stage.SEEDING):
            share = self._settings.seeding.background_share
            max_active = round((1.0 - share) * table.capacity) if share > 0 else None
            context = SeedingContext(table.free_slots, rendered, table.means_m[table.active], max_active)
            seeds = self._seeder.seed(frame, keyframe.relevance, context)
            return self._insert(replace(seeds, anchor=keyframe.anchor))

    def _revise(self, keyframe: Keyframe) -> None:
        """Set the active flags of what a keyframe shows, and remove the Gaussians that the keyframes see through."""
        update_roi_evidence(self._table, keyframe.frame, keyframe.relevance)
        frames = (earlier.frame for earlier in self._keyframes.buffer)
        self._table.remove(contradicted_rows(self._table.means_m, keyframe.frame, frames))

    def _insert(self, seeds: Seeds) -> int:
        """Add seeds within the cap; return how many."""
        seeding, table = self._settings.seeding, self._table
        min_background = int(seeding.background_share * table.capacity)
        return insert_seeds(table, seeds, seeding.opacity, self._rng, min_background)

    def _train(self, current: WindowView, motions: Float64[ndarray, "k 4 4"] | None, scheduler: StageScheduler) -> int:
        """Train on the window and the current view (MVO, Sec. III-D.2); without MVO on the current view alone.

        motions: of the keyframes by a loop, or None. The views that it moved train once more, because the map was
        trained from other poses.
        """
        window = self._keyframes.window
        views = (*window, current) if self._settings.components.mvo else (current,)
        done = self._trainer.train(views, self._extent_m, scheduler)
        moved = [] if motions is None else [view for view in window if (motions[view.keyframe.anchor] != _STAYS).any()]
        return done + self._trainer.retrain(moved, self._extent_m, scheduler)
