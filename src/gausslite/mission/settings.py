"""Settings of one robot's mission: its task, its perception, its map and the frames it uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from gausslite.config.option import check_options, option
from gausslite.config.values import (
    CAMERA_FORM,
    CORRECTION_FORM,
    NONE,
    PRIOR_FORM,
    not_empty,
    read_correction,
    read_prior,
    read_registration,
    read_target_points,
    read_up_axis,
    write_correction,
    write_numbers,
    write_prior,
    write_target_points,
)
from gausslite.datasets.source import Source
from gausslite.domain.pose import UpAxis, require_up_axis
from gausslite.domain.recording import TRACKED_PRIOR, CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import Region, TargetPoint
from gausslite.mapping.policies import EXTENSION_FLAGS, POLICIES, TASK, UNIFORM, disable, policy
from gausslite.mapping.settings import MapperSettings
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.perception.detector_file import MAX_TILES_PER_SIDE
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.choose import backends
from gausslite.render.cpu import MAX_THREADS, choose_threads

DEFAULT_MAX_GAUSSIANS = 150_000
"""The number that two CPU cores can train online at 640x480; the paper's cap of a million is for a GPU."""
MAX_ITERATIONS = 10_000
MAX_SEED = (1 << 32) - 1
MIN_RATE_HZ, MAX_RATE_HZ = 0.01, 1000.0

MAY_CHANGE = {"may_change": True}
"""Metadata of a settings field that may differ when a saved run is resumed."""
FILE = {"is_file": True}
"""Metadata of a settings field that names a file: a resumed run compares the name and not the folder."""

REGISTRATION_HELP = (
    "shift each depth image onto the colour image (registration), for sensors with two cameras: the colour camera's "
    "intrinsics in pixels, then the depth camera's position (metres) and rotation vector (degrees) in its frame; none: "
    "use depth as recorded"
)
CORRECTION_HELP = (
    "correct images for lens distortion (radtan or fisheye with OpenCV's coefficients), for the rolling shutter's "
    "readout time, and for the offset between the times of images and poses (seconds); none: use images as recorded"
)
POSE_PRIOR_HELP = (
    "standard deviations of the errors of poses (metres, degrees) and of exposure (gain and offset, 0 to 1), within "
    "which views are corrected; none: poses and colours are exact"
)
_DISABLE_HELP = (
    "switch off parts of the policy: sb (ROI seed budgeting; ROI: the task's region of interest), mvo (multi-view "
    "optimisation), roi (ROI optimisation), sis (stratified initial scaling), gfd (gradient-focused densification), "
    f"{', '.join(EXTENSION_FLAGS)}"
)


def default_policy(has_roi: bool) -> str:
    """Return the policy of a mission with a task or regions, or of one without both."""
    return TASK if has_roi else UNIFORM


class PoseMode(StrEnum):
    """Where the poses of frames come from."""

    GIVEN = "given"
    """The odometry's poses, without refinement."""
    REFINE = "refine"
    """The odometry's poses, refined within the pose prior."""
    TRACK = "track"
    """Tracking against the map; of the given poses, only the first one is used, as the start."""


class LoopMode(StrEnum):
    """Whether loops correct the map, where poses may err."""

    AUTO = "auto"
    """If the packages of the extra slam are installed."""
    ON = "on"
    OFF = "off"


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """Information about the scene of a mission: the upward direction and, for tests, the regions of objects.

    up_axis: unit vector of the world frame. Raises InvalidInputError.
    """

    up_axis: UpAxis = (0.0, 0.0, 1.0)
    regions: Mapping[str, Region] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_up_axis(self.up_axis)

    @classmethod
    def of(cls, source: Source) -> SceneInfo:
        """Return the upward direction and the ground-truth regions of a sequence."""
        return cls(source.up_axis, source.regions())


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """A sequence and which of its frames a mission uses."""

    spec: str = option(
        MISSING,
        'a folder (TUM, 7-Scenes, Replica, ZED or Record3D layout), a ROS bag ("bag:run1.mcap?depth=TOPIC"), or '
        '"sim:home?seed=0&trajectory=0", sim:home-1 to sim:home-8',
        key="source",
        metavar="SOURCE",
        convert=not_empty,
        metadata=MAY_CHANGE,
    )
    frames: str = option(":", "frame numbers to use (default: all)", metavar="START:STOP:STEP", metadata=MAY_CHANGE)
    size: str | None = option(None, "resize images to this size (default: the recorded size)", metavar="WxH")
    up_axis: UpAxis | None = option(
        None,
        "upward direction of the world (default: the source's)",
        key="up",
        metavar="X,Y,Z",
        plain_type=str,
        convert=read_up_axis,
        to_plain=write_numbers,
    )
    test_every: int | None = option(
        None, "hold out every N-th selected frame from mapping, for evaluation", metavar="N", low=2
    )
    depth_registration: DepthRegistration | None = option(
        None,
        REGISTRATION_HELP,
        key="register-depth",
        metavar=f"{NONE}|{CAMERA_FORM}",
        plain_type=str,
        convert=read_registration,
        to_plain=str,
    )  # the colour camera to register depth to, None if depth is registered already
    camera_correction: CameraCorrection | None = option(
        None,
        CORRECTION_HELP,
        metavar=f"{NONE}|{CORRECTION_FORM}",
        plain_type=str,
        convert=read_correction,
        to_plain=write_correction,
    )  # lens, rolling shutter and time offset, None for the lens of the files
    require_poses: bool = True  # False also uses frames without a pose, for tracking


@dataclass(frozen=True, slots=True)
class TaskSettings:
    """The task in natural language, or regions of space in its place; neither for a uniform map."""

    task: str | None = option(None, 'the robot\'s task, such as "Pick up the mug on the table"', metavar="TEXT")
    roi: Path | None = option(None, "voxel file of ground-truth regions", metavar="FILE.npz", metadata=FILE)
    objects: tuple[str, ...] = option((), "objects of --roi (default: all) or of SOURCE", metavar="A,B")
    target_at: tuple[TargetPoint, ...] = option(
        (),
        "points on target objects in metres; with a radius, all within it",
        metavar="X,Y,Z[,R]",
        repeats=True,
        plain_type=tuple[str, ...],
        convert=read_target_points,
        to_plain=write_target_points,
    )


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """The models that find the task's nouns. Without a model file, the ground truth of the sequence is used.

    segmenter: how detected boxes become masks, "yolo" (the detector's masks), "depth" or a FastSAM file; None for the
    model's own masks, or depth if it has none.

    asynchronous: mapping does not wait for detections; they run on their own thread and take effect when they are
    finished. detection_time_s: no further tile is started if it would end later than this; None for no limit.
    """

    model: Path | None = option(
        None,
        "an RF-DETR, YOLO, YOLO-World or Grounding DINO model (default: the source's ground truth)",
        key="detector",
        metavar="FILE.onnx",
        metadata=FILE,
    )
    threads: int | None = field(default=None, metadata=MAY_CHANGE)
    asynchronous: bool = field(default=False, metadata=MAY_CHANGE)
    segmenter: str | None = option(
        None,
        "a FastSAM model, the detector's own masks, or segmentation by depth and colour",
        metavar="FILE.onnx|yolo|depth",
        needs="detector",
        metadata=FILE,
    )
    vocabulary: Path | None = option(
        None,
        "the text encoder's vocabulary (default: vocab.txt or tokenizer.json in the model's folder)",
        metavar="FILE.txt",
        needs="detector",
        metadata=FILE,
    )
    accept_similar: bool = option(False, "also map objects of a class that is only similar to the task's noun")
    min_score: float | None = option(
        None, "score from which a detection counts (default: 0.25)", low=0.01, high=0.99, needs="detector"
    )
    tiles: int = option(
        2,
        "also detect in NxN enlarged parts of each keyframe, as time allows, to find small, distant objects; 1: off",
        low=1,
        high=MAX_TILES_PER_SIDE,
        needs="detector",
    )
    detection_time_s: float | None = field(default=None, metadata=MAY_CHANGE)

    def absolute(self) -> PerceptionSettings:
        """Return these settings for another process: paths do not depend on the current folder."""
        model = None if self.model is None else self.model.absolute()
        return replace(self, model=model, vocabulary=None if self.vocabulary is None else self.vocabulary.absolute())

    def at_rate(self, mission: MissionSettings) -> PerceptionSettings:
        """Return these settings with the mission's threads; at a rate, detection is asynchronous, on one thread."""
        if mission.rate_hz is None:
            return replace(self, threads=mission.threads)
        # the next keyframe comes at the latest after this time
        detection_time_s = RelevanceTrackerSettings().max_frames / mission.rate_hz
        return replace(self, threads=1, asynchronous=True, detection_time_s=detection_time_s)


def _iterations_of_policy(options: object) -> int | None:
    """Return the iterations per frame of the chosen policy; None at a rate."""
    if getattr(options, "rate", None) is not None:
        return None
    return policy(getattr(options, "policy", None) or TASK).optimization.iterations


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """Policy, budget, scheduling and hardware settings of one robot's mapping.

    disabled: see `gausslite.mapping.policies.disable`. rate_hz: each frame then trains as many iterations as fit into
    its time instead of a fixed number. pose_prior: tracked poses have TRACKED_PRIOR if it allows no pose error.
    """

    policy: str = option(TASK, "how the map is seeded and trained", metavar="NAME", choices=tuple(sorted(POLICIES)))
    disabled: frozenset[str] = option(frozenset(), _DISABLE_HELP, key="disable", metavar="A,B")
    max_gaussians: int = option(DEFAULT_MAX_GAUSSIANS, "largest map; with disk-mb, its part in memory", low=1)
    disk_mb: int = option(0, "disk space for what no camera sees; 0: all of the map is in memory", unit="MB", low=0)
    iterations: int | None = option(
        None,
        "iterations per frame (default: 8)",
        low=0,
        high=MAX_ITERATIONS,
        excludes="rate",
        computed=_iterations_of_policy,
    )
    rate_hz: float | None = option(
        None,
        "frames per second; each frame trains as long as its time allows",
        key="rate",
        metavar="HZ",
        unit="Hz",
        low=MIN_RATE_HZ,
        high=MAX_RATE_HZ,
    )
    seed: int = option(0, "seed of every random choice (default: 0)", low=0, high=MAX_SEED)
    threads: int | None = option(
        None,
        "threads (default: all that the processor has)",
        low=1,
        high=MAX_THREADS,
        computed=lambda _: choose_threads(None),
        metadata=MAY_CHANGE,
    )
    backend: str = option(
        "auto", "backend that renders and trains", key="rasterizer", choices=backends(), metadata=MAY_CHANGE
    )
    pose_prior: PoseExposurePrior = option(
        PoseExposurePrior(),
        POSE_PRIOR_HELP,
        metavar=f"{NONE}|{PRIOR_FORM}",
        plain_type=str,
        convert=read_prior,
        to_plain=write_prior,
    )
    poses: PoseMode = option(
        PoseMode.REFINE,
        "given: map with the given poses; refine: refine them within pose-prior; track: find poses by tracking the "
        "camera against the map, from the first given pose on",
    )
    loops: LoopMode = option(
        LoopMode.AUTO,
        "a keyframe that sees an earlier place again corrects poses and map, unless poses are exact (extra: slam); "
        "auto: if the extra is installed",
    )
    force: bool = option(
        False,
        "map although poses or depth contradict the images (default: end or skip, with what would agree)",
        metadata=MAY_CHANGE,
    )

    def __post_init__(self) -> None:
        check_options(self)
        # raises for an unknown policy or component
        self.mapper_settings()

    @property
    def follows_task(self) -> bool:
        """True if the policy's map depends on a task or on regions."""
        return policy(self.policy).components.follow_task

    @property
    def scheduler_settings(self) -> SchedulerSettings | None:
        """Settings of the frame scheduler; None if iterations are counted."""
        if self.rate_hz is None:
            return None
        return SchedulerSettings(1.0 / self.rate_hz)

    def mapper_settings(self) -> MapperSettings:
        """Return the settings of the named policy, with this mission's cap, iterations and disabled parts."""
        base = disable(policy(self.policy), self.disabled)
        optimization = base.optimization
        if self.iterations is not None:
            optimization = optimization.with_iterations(self.iterations)
        return replace(
            base,
            max_gaussians=self.max_gaussians,
            optimization=optimization,
            pose_prior=self.refinement_prior,
            pose_anchor_share=0.0 if self.poses is PoseMode.TRACK else base.pose_anchor_share,
        )

    @property
    def refinement_prior(self) -> PoseExposurePrior:
        """The prior within which views are refined in this pose mode."""
        if self.poses is PoseMode.GIVEN:
            return replace(self.pose_prior, translation_m=0.0, rotation_deg=0.0)
        if self.poses is PoseMode.TRACK and not self.pose_prior.has_pose_error:
            return TRACKED_PRIOR
        return self.pose_prior
