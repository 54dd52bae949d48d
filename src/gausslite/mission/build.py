"""Build the parts of one robot's loop from its settings: what attends to frames, and what maps them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.settings import MissionSettings, PerceptionSettings, SceneKnowledge
from gausslite.perception.attention import Attention, AttentionBeside, TaskAttention
from gausslite.perception.tracker import AttentionSettings
from gausslite.render.choose import choose_rasterizer

if TYPE_CHECKING:
    from gausslite.perception.families import Networks


def build_mapper(settings: MissionSettings) -> GaussianMapper:
    """A mapper with an empty map. Raises KernelError, InvalidInputError."""
    rasterizer = choose_rasterizer(settings.backend, settings.threads)
    return GaussianMapper(settings.mapper_settings(), rasterizer, seed=settings.seed)


def build_attention(graph: TaskGraph, scene: SceneKnowledge, perception: PerceptionSettings) -> Attention:
    """Attention to one task alone; see Attentions."""
    return Attentions(scene, perception).to(graph)


class Attentions:
    """Makes the attention to each task of a mission. The network is loaded with the first, and shared by all."""

    def __init__(self, scene: SceneKnowledge, perception: PerceptionSettings) -> None:
        self._scene = scene
        self._perception = perception
        self._networks: Networks | None = None
        self._executor: ThreadPoolExecutor | None = None

    def to(self, graph: TaskGraph) -> Attention:
        """Attention to a task: by the user's model files or, without one, by the scene's own ground truth.

        With `beside` the network runs on a thread of its own. Raises ModelFileError for a bad file and
        InvalidInputError when there is neither file nor ground truth.
        """
        settings = AttentionSettings(up_axis=self._scene.up_axis)
        if self._perception.model is not None:
            networks = self._loaded(self._perception.model)
            detector = networks.detector
            segmenter = networks.segmenter if self._perception.resegment else None
            if self._perception.beside:
                self._executor = self._executor or ThreadPoolExecutor(1, "detector")
                return AttentionBeside(graph, detector, self._executor, settings, segmenter)
            return TaskAttention(graph, detector, settings, segmenter)
        if not self._scene.regions:
            raise InvalidInputError(
                "detector: the sequence has no ground-truth regions; name an ONNX file with --detector"
            )
        from gausslite.perception.ground_truth import RegionDetector

        return TaskAttention(graph, RegionDetector(self._scene.regions), settings)

    def _loaded(self, model: Path) -> Networks:
        if self._networks is None:
            from gausslite.perception.families import Networks

            asked = self._perception
            self._networks = Networks(model, asked.segmenter, asked.vocabulary, asked.threads)
        return self._networks
