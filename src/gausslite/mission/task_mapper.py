"""Process one frame of a mission: from a posed image to the changed voxels of the task's region."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.checks import require_types
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import NounReport, ObjectLandmark
from gausslite.domain.pose import require_rigid, rotation_angle_deg, translation_m
from gausslite.domain.relevance import CameraView, DetectedImage, PointedObject, PointM, RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, select_prefix
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import FrameView, GaussianMapper
from gausslite.mapping.pose_corrector import LoopCounts
from gausslite.mapping.pose_estimation import CameraTracker
from gausslite.mapping.poses import PoseTable
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mapping.task_change import Reevaluation
from gausslite.mapping.voxel_exchange import InsertedVoxels, SentVoxelTracker
from gausslite.mission.frame_scheduler import FrameScheduler, FrameTiming
from gausslite.mission.localisation_monitor import UNPLACED, Admission, LocalisationMonitor, LocalisationState
from gausslite.perception.pointing import PointedMask, pointed_masks
from gausslite.perception.relevance import DelayedRelevance, RelevanceEstimator
from gausslite.render.rasterizer import Rendering

TRACKING_LOST: Final = "tracking is lost: the frame agrees with no part of the map"
REPEATED: Final = "the colour image is the one before, although the pose moved"
MOVING: Final = "everything moves"
_LEAST_MOTION_M, _LEAST_MOTION_DEG = 0.02, 1.0
"""An image that is repeated at a pose within these is of a robot at rest."""
_MAX_SHOWN = 16
_MAX_REEVALUATED = 3
"""Earlier keyframes that are evaluated again with each frame, after a task change and when an object becomes known."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameOutcome:
    """Result of one frame.

    changed_roi: the changed voxels of the task's region; None without a tracker, for a skipped frame, and if publishing
    waits for the next frame.
    """

    index: int  # number in the sequence
    iterations: int  # of training
    gaussians: int  # in the map afterwards
    roi_share: float  # of the pixels
    timing: FrameTiming
    skipped: str | None = None  # why the frame was not mapped, else None
    changed_roi: VoxelBatch | None = None
    detection_lag_frames: int | None = None  # age of the detection that finished during this frame
    reevaluation: Reevaluation = field(default_factory=Reevaluation)  # the earlier keyframes evaluated for a new task
    localisation: LocalisationState = LocalisationState.TRACKED  # whether the robot's place was known
    recovered: tuple[FrameOutcome, ...] = ()  # of frames that waited for the robot's place, mapped before this one
    joined: int = 0  # frames of a piece of map that was mapped apart and is part of the map now

    @property
    def mapped(self) -> tuple[FrameOutcome, ...]:
        """The outcomes of the frames that are mapped now, those that waited first."""
        return tuple(outcome for outcome in (*self.recovered, self) if outcome.skipped is None)


class LastImage:
    """Recognises a camera that repeats its last image while the robot moves; noise makes two images differ."""

    def __init__(self) -> None:
        self._checksum, self._T_world_camera = np.zeros(1, np.int64), np.eye(4)

    def is_repeated_by(self, frame: Frame) -> bool:
        """Return True if this frame has the image of the last other one at another pose."""
        checksum = np.array([zlib.crc32(frame.rgb.tobytes())])
        if (checksum != self._checksum).any():
            self._checksum, self._T_world_camera = checksum, frame.T_world_camera
            return False
        moved_m = translation_m(self._T_world_camera, frame.T_world_camera)
        turned_deg = rotation_angle_deg(self._T_world_camera, frame.T_world_camera)
        return moved_m > _LEAST_MOTION_M or turned_deg > _LEAST_MOTION_DEG

    def state(self) -> State:
        """Return the checksum and the pose of the last image."""
        return {"checksum": self._checksum, "pose": self._T_world_camera}

    def restore(self, state: State) -> None:
        """Continue from another object's state. Raises MapFileError, PoseError."""
        T_world_camera = get_array(state, "pose", (4, 4), np.float64)
        require_rigid("state last_image pose", T_world_camera)
        self._checksum = get_array(state, "checksum", (1,), np.int64).copy()
        self._T_world_camera = T_world_camera.copy()


class TaskMapper:
    """Estimate a frame's relevance, map it, and publish the changes of the task's region. Not thread-safe."""

    def __init__(
        self,
        estimator: RelevanceEstimator,
        mapper: GaussianMapper,
        sent_voxels: SentVoxelTracker | None = None,
        scheduler: FrameScheduler | None = None,
        publish: Callable[[VoxelBatch], None] = lambda _batch: None,
        tracker: CameraTracker | None = None,
        monitor: LocalisationMonitor | None = None,
    ) -> None:
        """Without a scheduler, each frame gets the fixed number of iterations of the mapper's settings.

        publish gets the changed voxels of each frame; its duration counts as part of the frame. Without a tracker,
        frames are mapped with their own poses; without a monitor, wherever these are.
        """
        self._estimator = estimator
        self._mapper = mapper
        self._sent_voxels = sent_voxels
        self._scheduler = scheduler or FrameScheduler()
        self._publish = publish
        self._tracker, self._monitor = tracker, monitor
        self._tracked = LocalisationState.TRACKED
        self._detected: DetectedImage | None = None
        self._defects: dict[str, int] = {}
        self._last_image = LastImage()
        # a person takes seconds to point, while newer frames replace most of the newest keyframes
        self._shown: deque[Frame] = deque(maxlen=_MAX_SHOWN)

    def assign(self, estimator: RelevanceEstimator | None = None) -> None:
        """Switch to another task with the next frame; None: the same, whose nouns mean other objects from now on.

        Earlier keyframes are re-evaluated, newest first and a few per frame. Voxels that were published for the old
        region stay published.
        """
        self._estimator = estimator or self._estimator
        self._mapper.reset_roi()
        if self._sent_voxels is not None:
            self._sent_voxels.freeze_sent()

    def extend(self, estimator: RelevanceEstimator) -> None:
        """Continue with the estimator of the same task with more targets; it takes over all objects."""
        estimator.restore(self._estimator.state())
        self._estimator = estimator

    def point_at(
        self, masks: Iterable[tuple[str, Bool[ndarray, "h w"], Frame]], excluded_m: Iterable[PointM] = ()
    ) -> None:
        """Add what a person points at (noun, mask, frame), leave out what is at points. Raises InvalidInputError."""
        for noun, mask, frame in masks:
            self._estimator.point_at(noun, mask, frame)
        for point_m in excluded_m:
            self._estimator.exclude(point_m)

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages of the relevance estimator, on frames with a defect and on loops, one line each."""
        defects = (
            f"frames are skipped in which {defect}; the first one is {index}" for defect, index in self._defects.items()
        )
        places = () if self._monitor is None else self._monitor.notes
        return (*self._estimator.notes, *defects, *places, *filter(None, [self.loops.describe()]))

    @property
    def localisation(self) -> LocalisationState:
        """Whether the robot's place is known, by the monitor, or by tracking."""
        return self._tracked if self._monitor is None else self._monitor.localisation

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        """The confirmed objects of the current task."""
        return self._estimator.objects

    @property
    def nouns(self) -> tuple[NounReport, ...]:
        """What the detector searches for each noun of the current task, and what it has detected."""
        return self._estimator.nouns

    def insert_team_voxels(self, received: VoxelBatch, grid: VoxelGrid) -> InsertedVoxels:
        """Insert voxels that a teammate trained more than this agent, for the current task's region.

        They are not sent back before this agent has trained them further.
        """
        inserted = self._mapper.insert_team_voxels(received, grid)
        if self._sent_voxels is not None:
            self._sent_voxels.mark_received(inserted.batch)
        return inserted

    @property
    def count(self) -> int:
        """Number of Gaussians in memory and on disk."""
        return self._mapper.count

    def gaussians(self, active_only: bool = False) -> Gaussians:
        """Return a copy of the map."""
        return self._mapper.gaussians(active_only)

    def parts(self, seen_by: Frame | None = None) -> Iterator[Gaussians]:
        """Yield a copy of the map in parts; see `GaussianMapper.parts`."""
        return self._mapper.parts(seen_by=seen_by)

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], motion: CameraMotion | None = None
    ) -> Rendering:
        """Render the map from a pose, with a moving camera if motion is given."""
        return self._mapper.render(camera, T_world_camera, motion)

    def camera_view(self) -> CameraView | None:
        """Return the newest keyframe, the camera's path and the newest detection; None before the first keyframe."""
        keyframes = self.keyframes()
        if not keyframes:
            return None
        newest, (times_ns, path) = keyframes[-1], self._mapper.poses.path()
        if not self._shown or self._shown[-1].id != newest.frame.id:
            self._shown.append(newest.as_recorded)
        return CameraView(
            rgb=newest.as_recorded.rgb,
            roi=newest.relevance.roi,
            camera=newest.frame.camera,
            frame_index=newest.frame.index,
            T_world_camera=newest.frame.T_world_camera,
            times_ns=times_ns,
            path=path,
            keyframes=np.stack([keyframe.frame.T_world_camera for keyframe in keyframes]),
            detected=self._detected,
        )

    @property
    def poses(self) -> PoseTable:
        """The poses of all mapped frames."""
        return self._mapper.poses

    def keyframes(self) -> list[Keyframe]:
        """Return the keyframes kept from the whole mission, oldest first."""
        return list(self._mapper.store.kept)

    def pointed_masks(self, pointed: Sequence[PointedObject]) -> list[PointedMask]:
        """Return the mask of each object pointed at on a known keyframe. Raises InvalidInputError."""
        frames = [*self._shown, *(keyframe.as_recorded for keyframe in self._mapper.store.kept)]
        return pointed_masks(pointed, sorted(frames, key=lambda frame: frame.capture_time_ns))

    def memory_mib(self) -> dict[str, float]:
        """Return the memory of the map's parts in MiB."""
        return self._mapper.memory_mib()

    def state(self) -> State:
        """Return everything that the next frame depends on, except the clock. Valid until the next frame."""
        sent_voxels: State = {} if self._sent_voxels is None else self._sent_voxels.state()
        return {
            **add_prefix("mapper", self._mapper.state()),
            **add_prefix("estimator", self._estimator.state()),
            **add_prefix("sent_voxels", sent_voxels),
            **add_prefix("tracker", {} if self._tracker is None else self._tracker.state()),
            **add_prefix("last_image", self._last_image.state()),
            **add_prefix("monitor", {} if self._monitor is None else self._monitor.state()),
        }

    def restore(self, state: State) -> None:
        """Continue from a state with the same settings and task. Raises MapFileError, InvalidInputError."""
        self._mapper.restore(select_prefix(state, "mapper"))
        self._estimator.restore(select_prefix(state, "estimator"))
        sent_voxels = select_prefix(state, "sent_voxels")
        if self._sent_voxels is not None and sent_voxels:
            self._sent_voxels.restore(sent_voxels)
        if self._tracker is not None:
            self._tracker.restore(select_prefix(state, "tracker"))
        self._last_image.restore(select_prefix(state, "last_image"))
        monitor = select_prefix(state, "monitor")
        if self._monitor is not None and monitor:
            self._monitor.restore(monitor)

    def process(self, frame: Frame, waited_s: float = 0.0) -> FrameOutcome:
        """Process one frame and return its outcome; waited_s is its time in the queue.

        A frame with a defect is skipped, one that the monitor refuses, one without a tracked pose, and one in which
        everything moves. When the monitor has found the robot again, the frames that waited are mapped first.
        """
        require_types(frame=(frame, Frame))
        self._scheduler.begin(waited_s)
        repeats = self._last_image.is_repeated_by(frame)
        if defect := frame.defect or (REPEATED if repeats else ""):
            return self._skip_defect(frame, defect)
        admitted = Admission((frame,)) if self._monitor is None else self._monitor.admit(frame, self._mapper)
        if not admitted.frames:
            return self._skip(frame, admitted.reason)
        if admitted.joined is not None:
            self._mapper.restore(admitted.joined)
            # neither map was trained on the other one's views, which show both now
            self._mapper.retrain(self._scheduler)
        if admitted.T_map_odometry is not None:
            self._mapper.poses.T_corrected_odometry = admitted.T_map_odometry
        recovered = []
        for waiting in admitted.frames[:-1]:
            recovered.append(self._process_placed(waiting))
            self._scheduler.begin(0.0)
        return replace(self._process_placed(frame), recovered=tuple(recovered), joined=admitted.mapped_apart)

    def _process_placed(self, frame: Frame) -> FrameOutcome:
        """Process a frame whose place is known."""
        posed = self._track(self._mapper.poses.add_odometry(frame))
        self._tracked = LocalisationState.LOST if posed is None else LocalisationState.TRACKED
        if posed is None:
            return self._skip(frame, TRACKING_LOST)
        view = FrameView(posed)
        if self._monitor is not None:
            view = self._mapper.look(posed, self._scheduler)
            # before anything that a frame shows to have moved is removed
            if not self._monitor.confirm(posed, view):
                return self._skip(frame, UNPLACED)
        view = self._mapper.leave_out_moving(view, self._scheduler)
        if view.frame.defect:
            return self._skip_defect(frame, MOVING)
        with self._scheduler.timing(Stage.RELEVANCE):  # w(u, v), Sec. III-B
            estimate = self._estimator.estimate(
                view.frame, None if view.rendered is None else view.rendered.expected_depth_m()
            )
        self._detected = estimate.detected or self._detected
        lag_frames = self._apply_delayed(estimate.delayed)  # before the frame: its training uses that region
        reevaluation = self._reevaluate_keyframes()  # a new task first needs what the map has of it
        # seeding and training, Sec. III-C and III-D
        mapped = self._mapper.map_view(view, estimate.relevance, self._scheduler)
        if self._tracker is not None and mapped.T_world_camera is not None:
            if mapped.T_corrected_earlier is not None:
                self._tracker.move(mapped.T_corrected_earlier)
            self._tracker.confirm(mapped.T_world_camera, mapped.anchor)
        changed_roi = self._publish_changed_roi()  # only the region leaves the robot, Sec. III-E
        return FrameOutcome(
            index=frame.index,
            iterations=mapped.iterations,
            gaussians=mapped.gaussians,
            roi_share=estimate.relevance.roi_share,
            timing=self._scheduler.end(),
            changed_roi=changed_roi,
            detection_lag_frames=lag_frames,
            reevaluation=reevaluation,
        )

    def idle_step(self) -> bool:
        """Run one iteration while no frame waits. Return False if nothing is mapped, or if the robot is not tracked."""
        return self.localisation is LocalisationState.TRACKED and self._mapper.idle_step()

    def changed_roi(self) -> VoxelBatch | None:
        """Return the voxels of the task's region that changed since the last call; None without a tracker."""
        if self._sent_voxels is None:
            return None
        unsent = self._mapper.gaussians(active_only=True, unsent_only=True)
        changes = self._sent_voxels.collect_changes(unsent, self._mapper.pager)
        self._mapper.pager.mark_sent()
        return changes

    @property
    def loops(self) -> LoopCounts:
        """What became of the loops so far."""
        corrector = self._mapper.corrector
        return LoopCounts() if corrector is None else corrector.counts

    @property
    def tracking_counts(self) -> Mapping[str, int]:
        """Number of frames by how their pose was found; empty without tracking."""
        return {} if self._tracker is None else self._tracker.counts

    def _track(self, frame: Frame) -> Frame | None:
        """Return the frame with its tracked pose, the frame itself without tracking, or None if the camera is lost."""
        if self._tracker is None:
            return frame
        with self._scheduler.timing(Stage.TRACKING):
            T_world_camera = self._tracker.track(frame)
        return None if T_world_camera is None else replace(frame, T_world_camera=T_world_camera)

    def _skip_defect(self, frame: Frame, defect: str) -> FrameOutcome:
        """Return the outcome of a frame with a defect, and note the first one."""
        self._defects.setdefault(defect, frame.index)
        return self._skip(frame, defect)

    def _skip(self, frame: Frame, reason: str) -> FrameOutcome:
        """Return the outcome of a frame that is not mapped."""
        count, timing, localisation = self._mapper.count, self._scheduler.end(), self.localisation
        return FrameOutcome(frame.index, 0, count, 0.0, timing, reason, localisation=localisation)

    def _apply_delayed(self, delayed: DelayedRelevance | None) -> int | None:
        """Update an earlier keyframe with its delayed relevance, and return the delay in frames."""
        if delayed is None:
            return None
        if (keyframe := self._mapper.store.get(delayed.frame)) is not None:
            with self._scheduler.timing(Stage.VIEW_PREPARATION):
                self._mapper.evaluate_keyframe(keyframe, delayed.relevance)
        return delayed.lag_frames

    def _reevaluate_keyframes(self) -> Reevaluation:
        """Evaluate earlier keyframes for a new task, then complete them with the objects that became known since.

        One per frame, more if there is time, up to a fixed number.
        """
        keyframes = seeded = 0
        while (keyframe := self._mapper.store.next_unevaluated) is not None:
            if not self._may_evaluate(keyframes):
                break
            with self._scheduler.timing(Stage.REEVALUATION):
                relevance = self._evaluate_past(keyframe)
                if relevance is None:
                    break
                seeded += self._mapper.evaluate_keyframe(keyframe, relevance)
                keyframes += 1
        completed = 0
        while self._may_evaluate(keyframes + completed):
            keyframe = self._mapper.store.next_incomplete(self._estimator.known_objects)
            if keyframe is None:
                break
            with self._scheduler.timing(Stage.REEVALUATION):
                relevance = self._estimator.complete(keyframe.as_recorded, keyframe.relevance)
                seeded += self._mapper.complete_keyframe(keyframe, relevance)
                completed += 1
        return Reevaluation(keyframes, seeded, completed)

    def _may_evaluate(self, keyframes: int) -> bool:
        """Return True if one more earlier keyframe may be evaluated with this frame."""
        if keyframes == _MAX_REEVALUATED:
            return False
        return keyframes == 0 or self._scheduler.has_time_for(Stage.REEVALUATION)

    def _evaluate_past(self, keyframe: Keyframe) -> RelevanceMap | None:
        """Return the relevance of an earlier keyframe. If that fails, the keyframe is not tried again."""
        try:
            return self._estimator.evaluate_past(keyframe.as_recorded)
        except Exception:
            self._mapper.evaluate_keyframe(keyframe, None)
            raise

    def _publish_changed_roi(self) -> VoxelBatch | None:
        if self._scheduler.skips(SkippableStage.PUBLISHING):
            return None
        with self._scheduler.timing(Stage.PUBLISHING):
            batch = self.changed_roi()
            if batch is not None:
                self._publish(batch)
            return batch
