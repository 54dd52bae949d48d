"""Build the parts of one robot's loop from its settings: what attends to frames, and what maps them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.settings import MissionSettings, PerceptionSettings, SceneInfo
from gausslite.perception.relevance_estimator import AsyncRelevanceEstimator, RelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.tracker import TrackerSettings
from gausslite.render.choose import choose_rasterizer

if TYPE_CHECKING:
    from gausslite.perception.model_registry import ModelRegistry


def build_mapper(settings: MissionSettings) -> GaussianMapper:
    """A mapper with an empty map. Raises KernelError, InvalidInputError."""
    rasterizer = choose_rasterizer(settings.backend, settings.threads)
    return GaussianMapper(settings.mapper_settings(), rasterizer, seed=settings.seed)


def build_estimator(
    graph: TaskGraph, scene: SceneInfo, perception: PerceptionSettings
) -> RelevanceEstimator:
    """RelevanceEstimator to one task alone; see RelevanceEstimatorFactory."""
    return RelevanceEstimatorFactory(perception, lambda: scene).to(graph)


def open_networks(perception: PerceptionSettings) -> ModelRegistry | None:
    """The user's model files, opened and tried; None without any. Raises ModelFileError, InvalidInputError."""
    if perception.model is None:
        return None
    from gausslite.perception.model_registry import ModelRegistry

    return ModelRegistry(perception.model, perception.segmenter, perception.vocabulary, perception.threads)


class RelevanceEstimatorFactory:
    """Makes the attention to each task of a mission. The network is loaded once, here, and shared by all."""

    def __init__(self, perception: PerceptionSettings, scene: Callable[[], SceneInfo]) -> None:
        """Asks for the scene with the first task, as a simulated one takes seconds to build. Raises ModelFileError."""
        self._perception = perception
        self._scene = functools.cache(scene)
        self._networks = open_networks(perception)
        self._executor: ThreadPoolExecutor | None = None

    def require_sight(self) -> None:
        """Raise InvalidInputError when there is neither file nor ground truth to find anything with."""
        if self._networks is None and not self._scene().regions:
            raise InvalidInputError(
                "detector: the sequence has no ground-truth regions; name an ONNX file with --detector"
            )

    def to(self, graph: TaskGraph) -> RelevanceEstimator:
        """RelevanceEstimator to a task: by the user's model files or, without one, by the scene's own ground truth.

        With `beside` the network runs on a thread of its own. Raises InvalidInputError when there is neither file nor
        ground truth.
        """
        scene = self._scene()
        settings = TrackerSettings(up_axis=scene.up_axis)
        if self._networks is not None:
            detector = self._networks.detector
            segmenter = self._networks.segmenter if self._perception.resegment else None
            if self._perception.asynchronous:
                self._executor = self._executor or ThreadPoolExecutor(1, "detector")
                return AsyncRelevanceEstimator(graph, detector, self._executor, settings, segmenter)
            return TaskRelevanceEstimator(graph, detector, settings, segmenter)
        self.require_sight()
        from gausslite.perception.ground_truth import RegionDetector

        return TaskRelevanceEstimator(graph, RegionDetector(scene.regions), settings)
