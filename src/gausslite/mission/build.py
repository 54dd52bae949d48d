"""Build the parts of one robot's loop from its settings: what attends to frames, and what maps them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.settings import MissionSettings, PerceptionSettings, SceneKnowledge
from gausslite.perception.attention import Attention, AttentionBeside, TaskAttention
from gausslite.perception.tracker import AttentionSettings
from gausslite.render.choose import choose_rasterizer


def build_mapper(settings: MissionSettings) -> GaussianMapper:
    """A mapper with an empty map. Raises KernelError, InvalidInputError."""
    rasterizer = choose_rasterizer(settings.backend, settings.threads)
    return GaussianMapper(settings.mapper_settings(), rasterizer, seed=settings.seed)


def build_attention(graph: TaskGraph, scene: SceneKnowledge, perception: PerceptionSettings) -> Attention:
    """Attention to a task: by the user's YOLO-seg file or, without one, by the scene's own ground truth.

    With `beside` the network runs on a thread of its own. Raises ModelFileError for a bad file and InvalidInputError
    when there is neither file nor ground truth.
    """
    settings = AttentionSettings(up_axis=scene.up_axis)
    if perception.model is not None:
        from gausslite.perception.yolo import load_yolo

        yolo = load_yolo(perception.model, threads=perception.threads)
        segmenter = yolo if perception.resegment else None
        if perception.beside:
            return AttentionBeside(graph, yolo, ThreadPoolExecutor(1, "detector"), settings, segmenter)
        return TaskAttention(graph, yolo, settings, segmenter)
    if not scene.regions:
        raise InvalidInputError(
            "detector: the sequence has no ground-truth regions; name a YOLO-seg ONNX file with --detector"
        )
    from gausslite.perception.ground_truth import RegionDetector

    return TaskAttention(graph, RegionDetector(scene.regions), settings)
