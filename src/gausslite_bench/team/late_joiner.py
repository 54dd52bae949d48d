"""A robot that joins late: ROI PSNR after each number of frames, alone and with the team's map of its task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, group_by_voxel
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.settings import MissionSettings, SceneInfo
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene
from gausslite_bench.team.scenes import TeamPlan
from gausslite_evaluation.metrics import psnr
from gausslite_evaluation.views import HeldOutView

_CHECKED = (1, 2, 4, 8, 16, 32, 64, 128)


@dataclass(frozen=True, slots=True)
class LateJoiner:
    """ROI PSNR in dB by number of frames; team_bytes: size of the region that the late robot receives."""

    scene: str
    team_psnr: float
    alone: tuple[tuple[int, float], ...]
    with_team: tuple[tuple[int, float], ...]
    team_bytes: int

    @property
    def row(self) -> str:
        """The table row."""
        alone, with_team = (", ".join(f"{n}: {db:.1f}" for n, db in curve) for curve in (self.alone, self.with_team))
        return f"| {self.scene} | {self.team_psnr:.1f} | {alone} | {with_team} | {self.team_bytes} |"


def run_late_joiner(plan: TeamPlan, settings: MissionSettings, size: tuple[int, int], grid: VoxelGrid) -> LateJoiner:
    """Map the first agent's task with its frames; then with the second agent's frames, alone and with that region.

    Raises InvalidInputError if no held-out view shows the region.
    """
    scene = plan.load(size)
    regions = scene.regions(scene.agents[0].objects)
    views = [
        view for view in (HeldOutView.of(scene_view.frame, regions) for scene_view in scene.views) if view.shows_region
    ]
    if not views:
        raise InvalidInputError(f"{plan.name}: expected held-out views that show the first task's region, got none")
    estimator = RegionRelevanceEstimator(regions)
    first, late = scene.agents[0].frames, scene.agents[1].frames

    def mapper(frames: Sequence[Frame], seed: int) -> TaskMapper:
        masks = [estimator.estimate(frame).relevance for frame in frames]
        recorded = RecordedRelevanceEstimator(Scene(plan.name, frames, masks, (), SceneInfo()))
        scheduler = FrameScheduler(settings.scheduler_settings)
        return TaskMapper(recorded, build_mapper(replace(settings, seed=seed)), SentVoxelTracker(grid), scheduler)

    team = mapper(first, settings.seed)
    for frame in first:
        team.process(frame)
    gaussians = team.gaussians()
    region = group_by_voxel(gaussians.take(gaussians.active), grid)
    curves = [_curve(mapper(late, settings.seed + 1), late, views, received, grid) for received in (None, region)]
    team_bytes = len(encode_subset(RoiSubset("team", "", 1, 1, region), grid))
    return LateJoiner(plan.name, _roi_psnr(team, views), curves[0], curves[1], team_bytes)


def _curve(
    mapper: TaskMapper,
    frames: Sequence[Frame],
    views: Sequence[HeldOutView],
    received: VoxelBatch | None,
    grid: VoxelGrid,
) -> tuple[tuple[int, float], ...]:
    """Map the frames, with the received region after the first, and score after some of them."""
    curve = []
    for count, frame in enumerate(frames, start=1):
        mapper.process(frame)
        if count == 1 and received is not None:
            mapper.insert_team_voxels(received, grid)
        if count in _CHECKED or count == len(frames):
            curve.append((count, _roi_psnr(mapper, views)))
    return tuple(curve)


def _roi_psnr(mapper: TaskMapper, views: Sequence[HeldOutView]) -> float:
    viewer = MapViewer(mapper.gaussians(), choose_rasterizer())
    return fmean(psnr(viewer.render_frame(view.frame).rgb, view.frame.rgb, view.roi) for view in views)


def late_joiner_table(results: Sequence[LateJoiner]) -> str:
    """Return one row per scene."""
    lines = [
        "A robot that joins late, on the first agent's task: ROI PSNR in dB by its number of frames, alone and with "
        "the team's region, and the bytes of that region.",
        "",
        "| scene | first agent | alone | with the team's map | bytes |",
        "|---|---|---|---|---|",
        *(result.row for result in results),
    ]
    return "\n".join(lines) + "\n"
