"""Build the parts of a mission from its settings: the mapper and the relevance estimators."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol

from gausslite.domain.errors import InvalidInputError, MissingPluginError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import NounMatch
from gausslite.domain.pose import UpAxis
from gausslite.domain.relevance import Region
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.pose_corrector import OpenCorrector, PoseCorrector
from gausslite.mapping.pose_estimation import CameraTracker, open_tracker
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.localisation_monitor import LocalisationMonitor
from gausslite.mission.prior_map import PriorMap
from gausslite.mission.settings import LoopMode, MissionSettings, PerceptionSettings, PoseMode, SceneInfo
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.detector import Detector, RegionDetector
from gausslite.perception.detector_file import DetectorOptions, detector_advice, open_detector
from gausslite.perception.relevance import (
    AsyncRelevanceEstimator,
    NoTaskEstimator,
    RegionRelevanceEstimator,
    RelevanceEstimator,
    TaskRelevanceEstimator,
)
from gausslite.perception.settings import EvidenceSettings, RelevanceTrackerSettings
from gausslite.plugins import Group, find, load
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer

if TYPE_CHECKING:
    from gausslite.wire.uplink import Uplink

EstimatorBuilder = Callable[[TaskGraph], RelevanceEstimator]
"""Returns the relevance estimator of a task."""
_GRID = VoxelGrid()
OpenMonitor = Callable[[PriorMap | None, bool | None, "Uplink | None"], LocalisationMonitor]
"""The plug-in of `gausslite.monitors`, with the earlier map that the mission continues; whether live frames are
compared with each other in the background, None: a recording's frames, compared before; and the link to a server."""


def build_mapper(settings: MissionSettings, prior: Gaussians | None = None, grid: VoxelGrid = _GRID) -> GaussianMapper:
    """Return a mapper with an empty map, or with an earlier one to continue. grid: of the voxels that are published.

    Raises KernelError, InvalidInputError, MissingPluginError, QuotaError if the earlier map exceeds max-gaussians.
    """
    rasterizer = choose_rasterizer(settings.backend, settings.threads)
    corrector = open_corrector(settings, rasterizer)
    policy, pager = settings.mapper_settings(), None
    if settings.disk_mb > 0:
        pager = load(Group.PAGERS, purpose="disk-mb")(policy, grid, settings.disk_mb * 1_000_000)
    return GaussianMapper(policy, rasterizer, settings.seed, prior, corrector, pager)


def open_corrector(settings: MissionSettings, rasterizer: Rasterizer) -> PoseCorrector | None:
    """Return what corrects poses by loops; None where poses are exact and, unless loops are on, if none is installed.

    Raises MissingPluginError.
    """
    prior = settings.refinement_prior
    if settings.loops is LoopMode.OFF or not prior.has_pose_error:
        return None
    try:
        open_plugin: OpenCorrector = load(Group.CORRECTORS, purpose="loops")
        return open_plugin(rasterizer, prior)
    except MissingPluginError:
        if settings.loops is LoopMode.ON:
            raise
        return None


def build_tracker(settings: MissionSettings, mapper: GaussianMapper) -> CameraTracker | None:
    """Return a tracker against the mapper's map; None if frames are mapped with their own poses.

    Raises MissingPluginError.
    """
    return open_tracker(mapper.render) if settings.poses is PoseMode.TRACK else None


def open_monitor(
    settings: MissionSettings,
    prior: PriorMap | None = None,
    in_background: bool | None = None,
    uplink: Uplink | None = None,
) -> LocalisationMonitor | None:
    """Return what judges the place of each frame; None with `force`, where the camera is tracked, or without a plug-in.

    in_background, uplink: see `OpenMonitor`.
    """
    is_needed = settings.poses is not PoseMode.TRACK and not settings.force
    open_plugin: OpenMonitor | None = find(Group.MONITORS) if is_needed else None
    return None if open_plugin is None else open_plugin(prior, in_background, uplink)


def chosen_detector(perception: PerceptionSettings) -> Detector | None:
    """Open the user's detector file; None without one. Raises ModelFileError, InvalidInputError, MissingPluginError."""
    if perception.model is None:
        return None
    options = DetectorOptions(
        segmenter=perception.segmenter,
        vocabulary=perception.vocabulary,
        threads=perception.threads,
        accept_similar=perception.accept_similar,
        min_score=perception.min_score,
        tiles_per_side=perception.tiles,
        time_limit_s=perception.detection_time_s,
    )
    return open_detector(perception.model, options)


def region_estimator(regions: Sequence[Region]) -> RelevanceEstimator:
    """Return the relevance estimator of given regions; without any, no pixel is relevant."""
    return RegionRelevanceEstimator(regions) if regions else NoTaskEstimator()


def build_task_mapper(
    settings: MissionSettings,
    estimators: EstimatorFactory,
    roi: TaskGraph | Sequence[Region],
    earlier: Gaussians | None = None,
    monitor: LocalisationMonitor | None = None,
) -> TaskMapper:
    """Return a mapper of an empty map, or of an earlier one. roi: a task, or regions of space; neither: uniform.

    Raises KernelError, QuotaError, and InvalidInputError for a task without a detector.
    """
    estimator = estimators.build(roi) if isinstance(roi, TaskGraph) else region_estimator(roi)
    mapper = build_mapper(settings, earlier)
    scheduler, tracker = FrameScheduler(settings.scheduler_settings), build_tracker(settings, mapper)
    return TaskMapper(estimator, mapper, scheduler=scheduler, tracker=tracker, monitor=monitor)


class RememberingDetector(Detector, Protocol):
    """A detector that also remembers what else it sees, over all tasks of a mission."""

    def remember(self, estimator: RelevanceEstimator, graph: TaskGraph, /) -> RelevanceEstimator:
        """Return a task's estimator that reports these objects after its own, and has them in its state."""


OpenMemory = Callable[[Detector, UpAxis], RememberingDetector]
"""The default of the group gausslite.object_memories."""


class EstimatorFactory:
    """Builds the relevance estimator of each task of a mission; all of them share the detector's network."""

    def __init__(
        self, perception: PerceptionSettings, scene: Callable[[], SceneInfo], needs_detector: bool = True
    ) -> None:
        """Open the detector. The scene is requested with the first task: a simulated one takes seconds to build.

        needs_detector: False if a person can point at what nothing detects. Raises ModelFileError, InvalidInputError.
        """
        self._needs_detector = needs_detector
        self._perception = perception
        self._scene = functools.cache(scene)
        self._detector = chosen_detector(perception)
        self._executor: ThreadPoolExecutor | None = None

    def in_scene(self, scene: Callable[[], SceneInfo]) -> EstimatorFactory:
        """Return a factory with the same detector for another scene."""
        other = copy.copy(self)
        other._scene = functools.cache(scene)
        other.__dict__.pop("memory", None)
        return other

    @functools.cached_property
    def memory(self) -> RememberingDetector | None:
        """What is remembered over all tasks; None if no package does."""
        remember: OpenMemory | None = find(Group.OBJECT_MEMORIES)
        return None if remember is None else remember(self._detector_or_truth(False), self._scene().up_axis)

    def require_detector(self) -> None:
        """Raise InvalidInputError if one is needed, and there is neither a model file nor ground truth."""
        if self._needs_detector and self._detector is None and not self._scene().regions:
            raise InvalidInputError(
                f"detector: expected --detector FILE.onnx, which finds the task's objects; {detector_advice()}"
            )

    def noun_matches(self, graph: TaskGraph) -> tuple[NounMatch, ...]:
        """Return what the detector searches for each noun of the task."""
        return self._detector_or_truth().matches(graph.queries)

    def build(self, graph: TaskGraph) -> RelevanceEstimator:
        """Return the relevance estimator of a task.

        It uses the user's detector or, without any, the scene's ground truth. Raises InvalidInputError without both,
        unless a person points at all targets.
        """
        evidence = EvidenceSettings.accept_similar() if self._perception.accept_similar else EvidenceSettings()
        settings = RelevanceTrackerSettings(up_axis=self._scene().up_axis, evidence=evidence)
        detector = self._detector_or_truth(bool(graph.queries))
        detector = self.memory or detector
        estimator: RelevanceEstimator = TaskRelevanceEstimator(graph, detector, settings)
        if self._detector is not None and self._perception.asynchronous:
            self._executor = self._executor or ThreadPoolExecutor(1, "detector")
            estimator = AsyncRelevanceEstimator(graph, detector, self._executor, settings)
        return estimator if self.memory is None else self.memory.remember(estimator, graph)

    def _detector_or_truth(self, is_needed: bool = True) -> Detector:
        if self._detector is not None:
            return self._detector
        if is_needed:
            self.require_detector()
        return RegionDetector(self._scene().regions)
