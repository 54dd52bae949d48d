"""Settings of one robot's mission: its task, its perception, its map and the frames it uses."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from gausslite.datasets.source import Source
from gausslite.domain.arguments import require_instance, require_number, require_whole
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.motion_model import MotionModel
from gausslite.domain.object_names import meant_by
from gausslite.domain.pose import UpAxis, require_up_axis
from gausslite.domain.pose_exposure_prior import TRACKED_PRIOR, PoseExposurePrior
from gausslite.domain.region import BallRegion, Region
from gausslite.mapping.policies import TASK, UNIFORM, disable, follows_task, policy
from gausslite.mapping.settings import MapperSettings
from gausslite.mapping.stages import SkippableStage
from gausslite.mission.frame_scheduler import SchedulerSettings
from gausslite.perception.detector import DEFAULT_TILES_PER_SIDE
from gausslite.render.cpu_kernels import MAX_THREADS

DEFAULT_MAX_GAUSSIANS = 150_000
"""The number that two CPU cores can train online at 640x480; the paper's cap of a million is for a GPU."""
MAX_ITERATIONS = 10_000
MAX_SEED = (1 << 32) - 1
MIN_RATE_HZ, MAX_RATE_HZ = 0.01, 1000.0
_SCHEDULER = SchedulerSettings()

MAY_CHANGE = {"may_change": True}
"""Metadata of a settings field that may differ when a saved run is resumed."""
FILE = {"is_file": True}
"""Metadata of a settings field that names a file: a resumed run compares the name and not the folder."""


def require_rate(rate_hz: float) -> None:
    """Raise InvalidInputError if the frame rate is outside 0.01 to 1000 Hz."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise InvalidInputError(f"rate: expected {MIN_RATE_HZ} to {MAX_RATE_HZ:g} Hz, got {rate_hz}")


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

    def regions_of(self, targets: Collection[str]) -> dict[str, Region]:
        """Return the regions of the objects that these nouns of a task mean."""
        meant = {name for target in targets for name in meant_by(target, self.regions)}
        return {name: roi for name, roi in self.regions.items() if name in meant}


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """A sequence and which of its frames a mission uses.

    spec: a folder or a simulated home; size: "WxH", None for the original size; test_every: every N-th frame is kept
    from mapping, for evaluation; depth_registration: the colour camera to register depth to, None if depth is
    registered already. camera_correction: lens, rolling shutter and time offset, None for images as recorded.
    require_poses: False also uses frames without a pose, for tracking.
    """

    spec: str = field(metadata=MAY_CHANGE)
    frames: str = field(default=":", metadata=MAY_CHANGE)
    size: str | None = None
    up_axis: UpAxis | None = field(default=None, metadata={"flag": "--up"})
    test_every: int | None = None
    depth_registration: DepthRegistration | None = field(default=None, metadata={"flag": "--register-depth"})
    camera_correction: CameraCorrection | None = None
    require_poses: bool = True


@dataclass(frozen=True, slots=True)
class TaskSettings:
    """The task in natural language, or regions of space in its place; neither for a uniform map."""

    task: str | None = None
    roi: Path | None = field(default=None, metadata=FILE)
    objects: tuple[str, ...] = ()
    roi_ball: tuple[BallRegion, ...] = ()


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """The models that find the task's nouns. Without a model file, the ground truth of the sequence is used.

    model: a YOLO, YOLO-World or Grounding DINO file. segmenter: how detected boxes become masks, "yolo" (the
    detector's masks), "depth" or a FastSAM file; None for the model's own masks, or depth if it has none. vocabulary:
    the text encoder's file; None for vocab.txt (Grounding DINO) or tokenizer.json (YOLO-World) next to the model.

    asynchronous: mapping does not wait for detections; they run on their own thread and take effect when they are
    finished. accept_similar: also map objects of a class that is only similar to the task's noun.

    tiles: the detector also runs in tiles x tiles parts of each keyframe, which finds small, distant objects; 1: off.
    detection_time_s: no further tile is started if it would end later than this; None for no limit.
    """

    model: Path | None = field(default=None, metadata={"flag": "--detector", **FILE})
    threads: int | None = field(default=None, metadata=MAY_CHANGE)
    asynchronous: bool = field(default=False, metadata=MAY_CHANGE)
    segmenter: str | None = field(default=None, metadata=FILE)
    vocabulary: Path | None = field(default=None, metadata=FILE)
    accept_similar: bool = False
    tiles: int = DEFAULT_TILES_PER_SIDE
    detection_time_s: float | None = field(default=None, metadata=MAY_CHANGE)


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """Policy, budget, scheduling and hardware settings of one robot's mapping.

    disabled: parts of the policy to switch off (see `gausslite.mapping.policies.disable`). rate_hz: frames per second;
    each frame then trains as many iterations as fit into its time instead of a fixed number. min_iterations,
    skip_stages and deadline_slack apply at a rate only, see `SchedulerSettings`. pose_prior: standard deviations of
    pose and exposure errors; tracked poses have TRACKED_PRIOR if it allows no pose error. motion: what predicts tracked
    poses.
    """

    policy: str = TASK
    disabled: frozenset[str] = field(default=frozenset(), metadata={"flag": "--disable"})
    max_gaussians: int = DEFAULT_MAX_GAUSSIANS
    iterations: int | None = None
    rate_hz: float | None = field(default=None, metadata={"flag": "--rate"})
    min_iterations: int = _SCHEDULER.min_iterations
    skip_stages: tuple[SkippableStage, ...] = _SCHEDULER.skip_stages
    deadline_slack: float = _SCHEDULER.deadline_slack
    seed: int = 0
    threads: int | None = field(default=None, metadata=MAY_CHANGE)
    backend: str = field(default="auto", metadata=MAY_CHANGE)
    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)
    poses: PoseMode = PoseMode.REFINE
    motion: MotionModel = field(default=MotionModel.VELOCITY, metadata={"flag": "--track-motion"})

    def __post_init__(self) -> None:
        self._require_types()
        if self.rate_hz is not None:
            require_rate(self.rate_hz)
        if not 0 <= self.min_iterations <= MAX_ITERATIONS:
            raise InvalidInputError(f"min_iterations: expected 0 to {MAX_ITERATIONS}, got {self.min_iterations}")
        if not 0 <= self.deadline_slack <= 1:
            raise InvalidInputError(
                f"deadline_slack: expected a share of a frame's time, 0 to 1, got {self.deadline_slack}"
            )
        if self.iterations is not None and not 0 <= self.iterations <= MAX_ITERATIONS:
            raise InvalidInputError(f"iterations: expected 0 to {MAX_ITERATIONS}, got {self.iterations}")
        if not 0 <= self.seed <= MAX_SEED:
            raise InvalidInputError(f"seed: expected 0 to {MAX_SEED}, got {self.seed}")
        if self.threads is not None and not 1 <= self.threads <= MAX_THREADS:
            raise InvalidInputError(f"threads: expected 1 to {MAX_THREADS}, got {self.threads}")
        # raises for an unknown policy or component, and for a cap of 0
        self.mapper_settings()

    def _require_types(self) -> None:
        """Raise InvalidInputError for values of other types than the fields'."""
        require_instance("policy", self.policy, str, "the name of a policy as text")
        require_instance("disabled", self.disabled, (frozenset, set), "a set of names such as frozenset({'sb'})")
        require_instance("pose_prior", self.pose_prior, PoseExposurePrior, "a PoseExposurePrior")
        require_instance("poses", self.poses, PoseMode, "a PoseMode")
        require_instance("motion", self.motion, MotionModel, "a MotionModel")
        require_instance("backend", self.backend, str, "the name of a backend as text")
        for name in ("max_gaussians", "iterations", "min_iterations", "seed", "threads"):
            value = getattr(self, name)
            if value is not None or name not in ("iterations", "threads"):
                require_whole(name, value)
        if self.rate_hz is not None:
            require_number("rate_hz", self.rate_hz)
        require_number("deadline_slack", self.deadline_slack)

    @property
    def follows_task(self) -> bool:
        """True if the policy's map depends on a task or on regions."""
        return follows_task(self.policy)

    @property
    def scheduler_settings(self) -> SchedulerSettings | None:
        """Settings of the frame scheduler; None if iterations are counted."""
        if self.rate_hz is None:
            return None
        return SchedulerSettings(1.0 / self.rate_hz, self.min_iterations, self.skip_stages, self.deadline_slack)

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
