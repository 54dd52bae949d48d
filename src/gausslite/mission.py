"""Build one robot's loop from settings: which frames, what attends to them, and how the map is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from gausslite.datasets.source import Source, UpAxis
from gausslite.domain.region import Region
from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import policy
from gausslite.mapping.settings import Components, MapperSettings
from gausslite.perception.attention import AttentionSettings, TaskAttention
from gausslite.render.choose import choose_rasterizer

DEFAULT_MAX_GAUSSIANS = 150_000
"""What two cores keep busy at 640x480; the paper's cap of a million is for a GPU."""


@dataclass(frozen=True, slots=True)
class SceneKnowledge:
    """What is known of a place before the robot looks: which way is up and, in tests, where the objects are."""

    up_axis: UpAxis = (0.0, 0.0, 1.0)
    regions: Mapping[str, Region] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source) -> SceneKnowledge:
        """What a sequence says about its place."""
        return cls(source.up_axis, source.regions())


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """What finds the task's nouns: a YOLO-seg file, or ground truth without one.

    resegment runs the network on frames between detections too; without it masks are cut by depth inside the
    re-projected boxes, which on a real kitchen is as exact at a third of the time.
    """

    model: Path | None = None
    resegment: bool = False
    threads: int | None = None


@dataclass(frozen=True, slots=True)
class MissionSettings:
    """How one robot maps.

    without switches components off by name (sb, mvo, roi, sis, gfd). rate_hz, when given, replaces the fixed number
    of iterations by what fits into 1 / rate_hz seconds a frame.
    """

    policy: str = "task"
    without: frozenset[str] = frozenset()
    max_gaussians: int = DEFAULT_MAX_GAUSSIANS
    iterations: int | None = None
    rate_hz: float | None = None
    seed: int = 0
    threads: int | None = None
    backend: str = "auto"

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0.01 <= self.rate_hz <= 1000:
            raise InvalidInputError(f"rate: expected 0.01 to 1000 Hz, got {self.rate_hz}")
        if self.iterations is not None and not 0 <= self.iterations <= 10_000:
            raise InvalidInputError(f"iterations: expected 0 to 10000, got {self.iterations}")

    @property
    def seconds_per_frame(self) -> float | None:
        """The time a frame may take; None where iterations are counted instead."""
        return None if self.rate_hz is None else 1.0 / self.rate_hz

    def mapper_settings(self) -> MapperSettings:
        """The named policy with this mission's cap, iterations and switches."""
        base = policy(self.policy)
        optimization = base.optimization
        if self.iterations is not None:
            optimization = optimization.with_iterations(self.iterations)
        return replace(
            base,
            max_gaussians=self.max_gaussians,
            components=_without(base.components, self.without),
            optimization=optimization,
        )


def build_mapper(settings: MissionSettings) -> GaussianMapper:
    """A mapper with an empty map. Raises KernelError, InvalidInputError."""
    rasterizer = choose_rasterizer(settings.backend, settings.threads)
    return GaussianMapper(settings.mapper_settings(), rasterizer, seed=settings.seed)


def build_attention(graph: TaskGraph, scene: SceneKnowledge, perception: PerceptionSettings) -> TaskAttention:
    """Attention to a task: by the user's YOLO-seg file or, without one, by the scene's own ground truth.

    Raises ModelFileError for a bad file and InvalidInputError when there is neither file nor ground truth.
    """
    settings = AttentionSettings(up_axis=scene.up_axis)
    if perception.model is not None:
        from gausslite.perception.yolo import load_yolo

        yolo = load_yolo(perception.model, threads=perception.threads)
        return TaskAttention(graph, yolo, settings, segmenter=yolo if perception.resegment else None)
    if not scene.regions:
        raise InvalidInputError(
            "detector: the sequence has no ground-truth regions; name a YOLO-seg ONNX file with --detector"
        )
    from gausslite.perception.ground_truth import RegionDetector

    return TaskAttention(graph, RegionDetector(scene.regions), settings)


def choose_regions(regions: Mapping[str, Region], names: Sequence[str]) -> list[Region]:
    """The regions with these names; all of them when no name is given. Raises InvalidInputError."""
    unknown = [name for name in names if name not in regions]
    if unknown or not regions:
        known = ", ".join(sorted(regions)) or "none"
        raise InvalidInputError(f"objects: expected names among {known}; got {', '.join(unknown) or 'none'}")
    return [regions[name] for name in names] if names else list(regions.values())


def frame_size(text: str | None, source: Source) -> tuple[int, int]:
    """Parse "WxH"; the sequence's own size when there is no text. Raises InvalidInputError."""
    if text is None:
        return source.camera.width_px, source.camera.height_px
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() for part in parts):
        raise InvalidInputError(f"size: expected WIDTHxHEIGHT such as 320x240, got {text!r}")
    width, height = int(parts[0]), int(parts[1])
    if not (16 <= width <= 4096 and 16 <= height <= 4096):
        raise InvalidInputError(f"size: expected sides of 16 to 4096 pixels, got {text!r}")
    return width, height


def _without(components: Components, names: frozenset[str]) -> Components:
    known = ("sb", "mvo", "roi", "sis", "gfd")
    unknown = sorted(names - set(known))
    if unknown:
        raise InvalidInputError(f"without: expected names among {', '.join(known)}, got {', '.join(unknown)}")
    return replace(components, **dict.fromkeys(names, False))
