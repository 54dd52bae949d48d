"""Map quality with real cameras: one walk with an ideal camera, and with shutter, blur and lens, corrected or not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum

from gausslite.calibration.calibrate import StatedValues, calibrate
from gausslite.datasets.corrected import CorrectedSource
from gausslite.datasets.files import RgbdImage, resize_rgbd
from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions
from gausslite.datasets.source import Source, WrappedSource
from gausslite.domain.camera import Lens
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.recording import CameraCorrection, PoseExposurePrior
from gausslite.evaluation.compare import average, score_view
from gausslite.evaluation.views import HeldOutView, MapViewer
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings, SceneInfo
from gausslite.mission.task_mapper import TaskMapper
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rendering
from gausslite_bench.quality.home_tasks import HomeTask
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene, make_scene

_TRAINING_TRAJECTORY, _HELD_OUT_TRAJECTORY = 0, 2
_MS_PER_S = 1e3


class CameraCondition(StrEnum):
    """The camera of a walk, and the correction of its images."""

    IDEAL = "ideal camera"
    UNCORRECTED = "uncorrected"
    TRUTH = "corrected with the truth"
    ESTIMATE = "corrected with estimates"


@dataclass(frozen=True, slots=True)
class CameraStudy:
    """One task in one home, walked at several angular speeds.

    A walk has frames * stride images; every stride-th one is mapped, all are there for the estimates. truth: the
    simulated camera; its time offset is 0.
    """

    task: HomeTask
    truth: CameraCorrection
    settings: MissionSettings
    frames: int = 24
    stride: int = 4
    views: int = 12
    size: tuple[int, int] = (320, 240)

    def __post_init__(self) -> None:
        for name in ("frames", "stride", "views"):
            if not 1 <= getattr(self, name) <= 1000:
                raise InvalidInputError(f"camera study {name}: expected 1 to 1000, got {getattr(self, name)}")
        if self.truth.readout_s < 0:
            raise InvalidInputError(
                f"camera study readout: expected at least 0 ms, as homes read rows from the top, "
                f"got {_MS_PER_S * self.truth.readout_s:g}"
            )
        if self.truth.time_offset_s:
            raise InvalidInputError("camera study: expected no time offset: simulated poses are exact")

    def run(self, speed_deg_s: int, on_scored: Callable[[CameraScore], None]) -> list[CameraScore]:
        """Return the scores in every condition at one angular speed; on_scored gets each. Raises GaussLiteError."""
        scores = []
        views = self._held_out()
        for condition, source, correction, evidence in self._sources(speed_deg_s):
            scene = self._scene(source, views)
            score = average([score_view(*rendering) for rendering in self._renderings(scene)])
            result = CameraScore(
                speed_deg_s, condition, score.roi_psnr, score.full_psnr, str(correction or ""), tuple(evidence)
            )
            scores.append(result)
            on_scored(result)
        return scores

    def _sources(
        self, speed_deg_s: int
    ) -> Iterator[tuple[CameraCondition, Source, CameraCorrection | None, Sequence[str]]]:
        walk = f"{self._spec(_TRAINING_TRAJECTORY, self.frames * self.stride)}&speed={speed_deg_s}"
        yield CameraCondition.IDEAL, open_source(walk), None, ()
        recorded = _CachedSource(open_source(walk + self._camera_options()))
        yield CameraCondition.UNCORRECTED, recorded, None, ()
        yield CameraCondition.TRUTH, CorrectedSource(recorded, self.truth), self.truth, ()
        found = calibrate(recorded, StatedValues(pose_prior=PoseExposurePrior()))
        reasons = [reason for evidence in found.evidence if not evidence.guaranteed for reason in evidence.reasons]
        yield CameraCondition.ESTIMATE, found.source, found.correction, reasons

    def _camera_options(self) -> str:
        options = f"&shutter={_MS_PER_S * self.truth.readout_s:g}ms&blur={_MS_PER_S * self.truth.exposure_s:g}ms"
        return options if self.truth.lens is None else f"{options}&lens={self.truth.lens}"

    def _held_out(self) -> list[HeldOutView]:
        source = open_source(f"{self._spec(_HELD_OUT_TRAJECTORY, self.views)}&noise=0&exposure=0")
        regions = choose_regions(source.regions(), self.task.objects)
        return [HeldOutView.of(source.frame(i), regions) for i in range(len(source))]

    def _scene(self, source: Source, views: Sequence[HeldOutView]) -> Scene:
        training = [source.frame(i) for i in range(0, len(source), self.stride)]
        regions = choose_regions(source.regions(), self.task.objects)
        return make_scene(self.task.task, training, views, regions, SceneInfo.of(source))

    def _renderings(self, scene: Scene) -> Iterator[tuple[Rendering, HeldOutView]]:
        """Map the training frames, and yield each held-out view's rendering with the view."""
        mapper = TaskMapper(
            RecordedRelevanceEstimator(scene),
            build_mapper(self.settings),
            scheduler=FrameScheduler(self.settings.scheduler_settings),
        )
        MissionRunner(mapper.process).run(scene.training).raise_if_stopped()
        viewer = MapViewer(mapper.gaussians(), choose_rasterizer(threads=self.settings.threads))
        for view in scene.held_out:
            yield viewer.render_frame(view.frame), view

    def _spec(self, trajectory: int, frames: int) -> str:
        width, height = self.size
        return f"sim:home-{self.task.home}?trajectory={trajectory}&frames={frames}&size={width}x{height}"


@dataclass(frozen=True, slots=True)
class CameraScore:
    """PSNR in dB of one walk: in the region (None if no view shows it) and over the image; the correction's text."""

    speed_deg_s: int
    condition: CameraCondition
    roi_psnr: float | None
    full_psnr: float
    correction: str
    evidence: tuple[str, ...] = ()

    def as_json(self) -> dict[str, object]:
        """Return the score as JSON values."""
        return asdict(self)


class _CachedSource(WrappedSource):
    """A source that keeps its frames: a blurred one takes a second to render, and three handlings use it."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._frames: dict[int, Frame] = {}

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        """Return the frame at position i, resized. Raises DatasetError."""
        if i not in self._frames:
            self._frames[i] = self._source.frame(i)
        frame = self._frames[i]
        image = resize_rgbd(RgbdImage(frame.rgb, frame.depth_m, frame.camera), size)
        return replace(
            frame, rgb=image.rgb, depth_m=image.depth_m, camera=image.camera, recorded_rgb=image.recorded_rgb
        )


def camera_table(scores: Sequence[CameraScore]) -> str:
    """Return one row per speed: ROI PSNR with each condition, the loss to the ideal camera, and the estimates."""
    names = list(CameraCondition)
    lines = [
        "ROI PSNR in dB (full image) on held-out views of an ideal camera; in brackets the difference to the first.",
        "",
        f"| degrees a second | {' | '.join(names)} | estimate |",
        f"|---|{'---|' * (len(names) + 1)}",
    ]
    for speed in dict.fromkeys(score.speed_deg_s for score in scores):
        row = {score.condition: score for score in scores if score.speed_deg_s == speed}
        cells = [_cell(row.get(name), row.get(CameraCondition.IDEAL)) for name in names]
        estimate = row[CameraCondition.ESTIMATE].correction if CameraCondition.ESTIMATE in row else ""
        lines.append(f"| {speed} | {' | '.join(cells)} | {estimate.replace('|', ' ')} |")
    return "\n".join(lines) + "\n"


def read_truth(readout_ms: float, exposure_ms: float, lens: str | None) -> CameraCorrection:
    """Return the simulated camera of these options; lens "none" or None for a pinhole. Raises InvalidInputError."""
    parsed = None if lens in (None, "none") else Lens.parse(str(lens))
    return CameraCorrection(parsed, readout_ms / _MS_PER_S, exposure_s=exposure_ms / _MS_PER_S)


def _cell(score: CameraScore | None, ideal: CameraScore | None) -> str:
    if score is None:
        return ""
    roi = "no view" if score.roi_psnr is None else f"{score.roi_psnr:.2f}"
    text = f"{roi} ({score.full_psnr:.2f})"
    if ideal is None or ideal is score or score.roi_psnr is None or ideal.roi_psnr is None:
        return text
    return f"{text} [{score.roi_psnr - ideal.roi_psnr:+.2f}]"
