"""What a trial maps and is judged on: training frames with their masks, and held-out views off the training walk."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.calibration.pose_exposure_prior import PoseExposurePrior
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.intrinsics import CAMERA_FILE, INTRINSICS_FILE, find_beside_or_above
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import balls_for_small_objects, choose_regions, load_voxel_regions
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.source import Source
from gausslite.domain.frame import Frame
from gausslite.domain.pose import UpAxis
from gausslite.domain.region import Region
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State
from gausslite.errors import DatasetError, InvalidInputError
from gausslite.evaluation.views import MIN_ROI_PIXELS, HeldOutView
from gausslite.mission.settings import SceneInfo
from gausslite.perception.fixed_relevance import RegionRelevanceEstimator
from gausslite.perception.relevance_estimator import RelevanceEstimate
from gausslite.perception.vocabulary import head_of
from gausslite_bench.quality.home_tasks import HomeTask

_WALKS = (0, 1)
_FIRST_WALK_SHARE = 2 / 3
_MOST_FRAMES = 100_000
_NUMBERED = re.compile(r"seq-?\d+")
"""Folders whose name says nothing without that of the folder above."""


class UnseenRegionError(DatasetError):
    """No held-out view shows enough of the task's region: there is nothing to judge a map by."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A task in a place, in memory: every trial on it sees the same frames and the same masks."""

    task: str
    training: Sequence[Frame]
    masks: Sequence[RelevanceMap]
    held_out: Sequence[HeldOutView]
    knowledge: SceneInfo

    @property
    def roi_share(self) -> float:
        """Share of the pixels that show the region, over the held-out views that show it at all."""
        shares = [float(view.roi.mean()) for view in self.held_out if view.roi.any()]
        return float(np.mean(shares)) if shares else 0.0


@dataclass(frozen=True, slots=True)
class PosePolicy:
    """How far what is said of a scene's views can be believed.

    pose_prior says how wrong poses and colours may be, for mapping; with fit_views the held-out views are scored a
    second time with their own pose and colours fitted.
    """

    pose_prior: PoseExposurePrior = field(default_factory=PoseExposurePrior)
    fit_views: bool = False


REAL_CAMERA = PosePolicy(PoseExposurePrior(translation_m=0.01, rotation_deg=0.5, gain=0.1, offset=0.03), fit_views=True)
"""A hand-held camera that sets its own exposure, tracked to about a centimetre."""


@runtime_checkable
class ScenePlan(Protocol):
    """A scene before its frames are made."""

    @property
    def name(self) -> str:
        """A short name for tables and files."""
        ...

    @property
    def task(self) -> str:
        """What the robot is asked to do."""
        ...

    @property
    def trust(self) -> PosePolicy:
        """How far its views are believed, by every policy alike."""
        ...

    def settings(self) -> Mapping[str, object]:
        """All that its frames and scores depend on, for telling finished trials from others."""
        ...

    def place(self) -> Mapping[str, object]:
        """What its training frames depend on: plans of one place share the maps that know no task."""
        ...

    def load(self, size: tuple[int, int]) -> Scene:
        """Make the frames at (width, height). Raises DatasetError, InvalidInputError."""
        ...


@dataclass(frozen=True, slots=True)
class HomeScenePlan:
    """A pair in its simulated home: both training walks with a real camera's flaws, held-out views without."""

    pair: HomeTask
    frames: int = 60
    views: int = 24
    seed: int = 0
    trust: PosePolicy = field(default_factory=PosePolicy)

    def __post_init__(self) -> None:
        _require_count("frames", self.frames)
        _require_count("views", self.views)

    @property
    def name(self) -> str:
        """Such as home-3-search."""
        return self.pair.name

    @property
    def task(self) -> str:
        """The pair's."""
        return self.pair.task

    def settings(self) -> Mapping[str, object]:
        """The walks and the objects."""
        return {
            "specs": [self._spec(*walk) for walk in self._training_walks()] + [self._held_out_spec()],
            "task": self.task,
            "objects": list(self.pair.objects),
            "trust": str(self.trust),
        }

    def place(self) -> Mapping[str, object]:
        """The training walks."""
        return {"specs": [self._spec(*walk) for walk in self._training_walks()]}

    def load(self, size: tuple[int, int]) -> Scene:
        """Both walks one after the other, as one mission."""
        walks = [open_source(f"{self._spec(*walk)}&size={size[0]}x{size[1]}") for walk in self._training_walks()]
        training = [walk.frame(i) for walk in walks for i in range(len(walk))]
        beside = open_source(f"{self._held_out_spec()}&size={size[0]}x{size[1]}")
        regions = choose_regions(walks[0].regions(), self.pair.objects)
        views = [HeldOutView.of(beside.frame(i), regions) for i in range(len(beside))]
        return _scene(self.task, training, views, regions, SceneInfo.of(walks[0]))

    def _training_walks(self) -> list[tuple[int, int]]:
        first = max(1, round(_FIRST_WALK_SHARE * self.frames))
        return list(zip(_WALKS, (first, self.frames - first), strict=True))

    def _spec(self, trajectory: int, frames: int) -> str:
        return f"sim:home-{self.pair.home}?seed={self.seed}&trajectory={trajectory}&frames={frames}"

    def _held_out_spec(self) -> str:
        return f"{self._spec(2, self.views)}&noise=0&exposure=0"


@dataclass(frozen=True, slots=True)
class RealScenePlan:
    """A real sequence and the objects of one kind in it; every eighth frame is held out.

    frames, when given, thins the sequence to about that many training frames.
    """

    folder: Path
    roi: Path
    kind: str
    objects: tuple[str, ...]
    frames: int | None = None
    up_axis: UpAxis | None = None
    depth_registration: DepthRegistration | None = None
    trust: PosePolicy = REAL_CAMERA
    hold_out: HeldOutSplit = field(default_factory=HeldOutSplit)

    def __post_init__(self) -> None:
        if not self.kind or "/" in self.kind:
            raise InvalidInputError(f"{self.roi}: expected objects that can name files, got {', '.join(self.objects)}")
        if self.frames is not None:
            _require_count("frames", self.frames)

    @property
    def name(self) -> str:
        """Such as redkitchen-chair."""
        folder = self.folder.resolve()
        place = f"{folder.parent.name}-{folder.name}" if _NUMBERED.fullmatch(folder.name) else folder.name
        return f"{place}-{self.kind}"

    @property
    def task(self) -> str:
        """A search for the kind."""
        return f"Find the {self.kind}"

    def settings(self) -> Mapping[str, object]:
        """The place, the objects and the file that says where they are."""
        regions = hashlib.sha256(self.roi.read_bytes()).hexdigest()
        return {**self.place(), "objects": list(self.objects), "regions": regions, "trust": str(self.trust)}

    def place(self) -> Mapping[str, object]:
        """The folder, what is used of its frames, and the files that say what camera took them."""
        cameras = [find_beside_or_above(self.folder, name) for name in (CAMERA_FILE, INTRINSICS_FILE)]
        files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in cameras if path is not None}
        camera = None if self.depth_registration is None else str(self.depth_registration)
        used = {"frames": self.frames, "up": self.up_axis, "hold_out": self.hold_out.every, "colour_camera": camera}
        return {"folder": str(self.folder.resolve()), **used, **files}

    def load(self, size: tuple[int, int]) -> Scene:
        """The frames with depth, split. Raises UnseenRegionError too."""
        source = open_source(str(self.folder), self.up_axis, self.depth_registration)
        known = balls_for_small_objects(load_voxel_regions(self.roi))
        regions = choose_regions(known, self.objects)
        training, held_out = self.hold_out.split(self._positions(source))
        views = [HeldOutView.of(source.frame(i, size), regions) for i in held_out]
        views = [view for view in views if view.frame.has_depth]
        if views and not any(view.shows_region for view in views):
            raise UnseenRegionError(
                f"{self.name}: expected held-out views that show at least {MIN_ROI_PIXELS} pixels of "
                f"{', '.join(self.objects)} at {size[0]}x{size[1]}, got none of {len(views)}"
            )
        knowledge = SceneInfo(source.up_axis, known)
        return _scene(self.task, [source.frame(i, size) for i in training], views, regions, knowledge)

    def _positions(self, source: Source) -> list[int]:
        if self.frames is None:
            return list(range(len(source)))
        count = min(len(source), round(self.frames * self.hold_out.every / (self.hold_out.every - 1)))
        return sorted({round(i) for i in np.linspace(0, len(source) - 1, count)})


def real_plans(
    folder: Path,
    roi: Path,
    frames: int | None = None,
    up_axis: UpAxis | None = None,
    trust: PosePolicy = REAL_CAMERA,
) -> list[RealScenePlan]:
    """One plan for each kind of object in the file: mug_1 and mug_2 are the kind mug. Raises DatasetError."""
    kinds: dict[str, list[str]] = {}
    for name in load_voxel_regions(roi):
        kinds.setdefault(head_of(name), []).append(name)
    return [
        RealScenePlan(folder, roi, kind, tuple(objects), frames, up_axis, trust=trust)
        for kind, objects in kinds.items()
    ]


def choose_kinds(plans: Sequence[RealScenePlan], asked: Sequence[str]) -> list[RealScenePlan]:
    """Those about a kind that is asked for; all when none is. Raises InvalidInputError for a kind that is not there."""
    known = [plan.kind for plan in plans]
    unknown = [kind for kind in asked if kind not in known]
    if unknown:
        raise InvalidInputError(f"kinds: expected names among {', '.join(known)}, got {', '.join(unknown)}")
    return [plan for plan in plans if not asked or plan.kind in asked]


class RecordedRelevanceEstimator:
    """An RelevanceEstimator that knows each training frame's mask from before, so that no policy pays for making it."""

    def __init__(self, scene: Scene) -> None:
        # by frame and not by pose: a robot that stands still sees what moves, and other holes
        self._masks = dict(zip(scene.training, scene.masks, strict=True))

    @property
    def notes(self) -> tuple[str, ...]:
        """None: nothing has to be found."""
        return ()

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        """The ground truth."""
        del rendered_depth_m
        return RelevanceEstimate(self._masks[frame])

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        """The ground truth."""
        return self._masks[frame]

    def state(self) -> State:
        """Nothing: every frame's relevance is looked up."""
        return {}

    def restore(self, state: State) -> None:
        """Nothing to take over."""
        del state


def _require_count(name: str, count: int) -> None:
    if not 2 <= count <= _MOST_FRAMES:
        raise InvalidInputError(f"{name}: expected 2 to {_MOST_FRAMES}, got {count}")


def _scene(
    task: str,
    training: Sequence[Frame],
    views: Sequence[HeldOutView],
    regions: Sequence[Region],
    knowledge: SceneInfo,
) -> Scene:
    usable = [frame for frame in training if frame.has_depth]
    seen = [view for view in views if view.frame.has_depth]
    if not usable or not seen:
        came = f"{len(usable)} and {len(seen)}"
        raise DatasetError(f"{task!r}: expected training frames and held-out views with depth, got {came}")
    attention = RegionRelevanceEstimator(regions)
    return Scene(task, usable, [attention.estimate(frame).relevance for frame in usable], seen, knowledge)
