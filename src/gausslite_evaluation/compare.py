"""Score maps on held-out views, inside the task's region and over the whole image (Sec. IV-A, metrics).

Each view has its own PSNR, SSIM and depth error; ROI figures use the region's pixels of that view. The score of a map
is the mean over its views. Views with fewer than MIN_ROI_PIXELS region pixels count for the whole image only. PSNR is
capped at MAX_PSNR_DB. SSIM is the single-scale variant.

A robot plans in the map with T_map_odometry · (its odometry's pose). So views are also scored from the odometry's pose
after the published correction. It comes from the mapped frames around a held-out view, or from the last one before it;
the view's own image is not used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from statistics import fmean
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import CorrectionTrack
from gausslite.domain.relevance import Region
from gausslite.mission.evaluation import RenderFrame, TrainingFit
from gausslite.render.map_viewer import MapViewer
from gausslite.render.rasterizer import Rasterizer, Rendering
from gausslite_evaluation.lpips import Lpips
from gausslite_evaluation.metrics import covered_share, depth_l1_m, gradient_deviation, laplacian_ratio, psnr, ssim_map
from gausslite_evaluation.pictures import comparison_sheet
from gausslite_evaluation.views import HeldOutView, largest_roi_per_segment, largest_roi_views, render_fitted

MAX_PSNR_DB = 100.0
"""Cap on a view's PSNR: equal images, such as a saturated region, would make the mean infinite."""
_COVERED_ALPHA = 0.5


@dataclass(frozen=True, slots=True)
class ImageScore:
    """Scores of one view over the whole image, or inside the region.

    covered: share of the pixels with measured depth where the map's alpha exceeds 0.5. The depth error uses only those
    pixels. laplacian_ratio, gradient_deviation: `sharpness`.
    """

    psnr: float
    ssim: float
    depth_l1_m: float | None
    covered: float | None
    lpips: float | None
    laplacian_ratio: float | None
    gradient_deviation: float


@dataclass(frozen=True, slots=True)
class ViewScore:
    """Scores of one view; roi is None if the view shows too little of the region."""

    index: int
    roi_pixels: int
    full: ImageScore
    roi: ImageScore | None


@dataclass(frozen=True, slots=True)
class MapScores:
    """Means over the views: PSNR in dB, depth in metres, coverage as a share.

    laplacian_ratio: sharpness relative to the photographs, 1 for equal; gradient_deviation: 0 for equal images.
    A figure is None if no view has it; LPIPS needs a file. n_views and n_roi_views count the views behind the
    full-image and the ROI figures. roi_pixels sums the region's pixels over the n_roi_views views.
    """

    roi_psnr: float | None
    roi_ssim: float | None
    full_psnr: float
    full_ssim: float
    roi_depth_l1_m: float | None
    roi_covered: float | None
    n_views: int
    n_roi_views: int
    roi_pixels: int
    full_depth_l1_m: float | None = None
    full_covered: float | None = None
    roi_lpips: float | None = None
    full_lpips: float | None = None
    roi_laplacian_ratio: float | None = None
    full_laplacian_ratio: float | None = None
    roi_gradient_deviation: float | None = None
    full_gradient_deviation: float | None = None


def evaluate(gaussians: Gaussians, views: Sequence[HeldOutView], rasterizer: Rasterizer) -> MapScores:
    """Return the mean scores of the map over the held-out views. Raises InvalidInputError without views."""
    viewer = MapViewer(gaussians, rasterizer)
    return average([score_view(viewer.render_frame(view.frame), view) for view in views])


def score_training_views(
    render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]], count: int = 5
) -> TrainingFit:
    """Return the PSNR over the keyframes with the largest region in each part of a run, at most `count`.

    The map was trained on them, so it only shows whether the map fits what the camera saw.
    """
    keyframes = [(frame, roi) for frame, roi in keyframes if frame.has_depth]  # one without is left out as a whole
    pixels = [int(np.count_nonzero(roi)) for _, roi in keyframes]
    in_region, in_images = [], []
    for i in sorted(largest_roi_per_segment(pixels, count)):
        view = HeldOutView(*keyframes[i])
        rgb = render(view.frame).rgb
        trained = None if view.frame.left_out is None else ~view.frame.left_out
        in_images.append(min(psnr(rgb, view.frame.rgb, trained), MAX_PSNR_DB))
        if view.shows_region:
            in_region.append(min(psnr(rgb, view.frame.rgb, view.roi), MAX_PSNR_DB))
    if not in_images:
        raise InvalidInputError("keyframes: expected at least one, got none")
    return TrainingFit(fmean(in_region) if in_region else None, fmean(in_images), len(in_images))


def score_view(rendering: Rendering, view: HeldOutView, lpips: Lpips | None = None) -> ViewScore:
    """Return the scores of one rendering against its frame."""
    rgb, measured_m = view.frame.rgb, view.frame.depth_m
    similarity, depth_m = ssim_map(rendering.rgb, rgb), rendering.expected_depth_m(_COVERED_ALPHA)

    def score(mask: Bool[ndarray, "h w"] | None) -> ImageScore:
        return ImageScore(
            psnr=min(psnr(rendering.rgb, rgb, mask), MAX_PSNR_DB),
            ssim=float((similarity if mask is None else similarity[mask]).mean()),
            depth_l1_m=depth_l1_m(depth_m, measured_m, mask),
            covered=covered_share(depth_m, measured_m, mask),
            lpips=None if lpips is None else lpips.distance(rendering.rgb, rgb, mask),
            laplacian_ratio=laplacian_ratio(rendering.rgb, rgb, mask),
            gradient_deviation=gradient_deviation(rendering.rgb, rgb, mask),
        )

    roi = score(view.roi) if view.shows_region else None
    return ViewScore(view.frame.index, int(np.count_nonzero(view.roi)), score(None), roi)


def average(scores: Sequence[ViewScore]) -> MapScores:
    """Return the mean of the views' scores. Raises InvalidInputError without views."""
    if not scores:
        raise InvalidInputError("held-out views: expected at least one, got none")
    rois = [score.roi for score in scores if score.roi is not None]
    images = {"roi": rois, "full": [score.full for score in scores]}
    means: dict[str, Any] = {
        f"{part}_{figure.name}": _mean_or_none(of_part, figure.name)
        for part, of_part in images.items()
        for figure in fields(ImageScore)
    }
    roi_pixels = sum(score.roi_pixels for score in scores if score.roi is not None)
    return MapScores(**means, n_views=len(scores), n_roi_views=len(rois), roi_pixels=roi_pixels)


def _mean_or_none(scores: Sequence[ImageScore], figure: str) -> float | None:
    """Return the mean of a figure over the scores that have it."""
    listed = [value for score in scores if (value := getattr(score, figure)) is not None]
    return fmean(listed) if listed else None


@dataclass(slots=True)
class CorrectedScores:
    """Scores of held-out views without any fit. corrections: those that the mapper published with the map.

    raw: from the given poses. interpolated: with the corrections of the frames before and after each view. before:
    with that of the last frame before it, as a live robot.
    """

    corrections: CorrectionTrack
    raw: list[ViewScore] = field(default_factory=list)
    interpolated: list[ViewScore] = field(default_factory=list)
    before: list[ViewScore] = field(default_factory=list)

    def add(self, viewer: MapViewer, view: HeldOutView) -> None:
        """Score one view in the three ways."""
        frame, time_ns = view.frame, view.frame.capture_time_ns
        self.raw.append(score_view(viewer.render_frame(frame), view))
        for scores, T_map_odometry in (
            (self.interpolated, self.corrections.interpolated(time_ns)),
            (self.before, self.corrections.before(time_ns)),
        ):
            corrected = replace(frame, T_world_camera=T_map_odometry @ frame.T_world_camera)
            scores.append(score_view(viewer.render_frame(corrected), view))

    def summary(self) -> dict[str, dict[str, float | None]]:
        """Return the mean PSNR (dB) and SSIM of each way, in the region and over the full image."""
        ways = {"raw": self.raw, "map_to_odom": self.interpolated, "map_to_odom_before": self.before}
        means = {way: average(scores) for way, scores in ways.items()}
        return {
            way: {name: getattr(mean, name) for name in ("roi_psnr", "roi_ssim", "full_psnr", "full_ssim")}
            for way, mean in means.items()
        }


MAP_PURPOSES = {
    "concatenation": "all Gaussians of all robots: nothing is left out, and common places are there several times",
    "vote": "each voxel from the robot that shows it best: the team's map, for all tasks at the size of one",
    "refine": "the voted map, trained further on all robots' keyframes after the mission: for views of the whole place",
}
TEAM_MAP = "vote"
"""What each fused map is for; a robot's own map is for its own task."""


def map_purpose(name: str, task: str = "") -> str:
    """Return what a map of a team is for; task: that of the robot whose own map it is."""
    return MAP_PURPOSES.get(name) or f"what one robot saw, in detail for its own task{f' ({task})' if task else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class TeamScores:
    """Scores by map name, also inside each task's region alone (by task, then map), and a few comparison sheets."""

    scores: dict[str, MapScores]
    by_task: dict[str, dict[str, MapScores]]
    sheets: dict[str, UInt8[ndarray, "_ _ 3"]]


def score_team(
    viewers: Mapping[str, MapViewer],
    views: Sequence[HeldOutView],
    task_regions: Mapping[str, Sequence[Region]],
    fit_views: bool = False,
    sheets: int = 4,
) -> TeamScores:
    """Return the scores of every map over all held-out views, with comparison sheets of `sheets` views.

    views: with the regions of all tasks. The sheets show the views with the largest region, spread over the sequence.
    With fit_views, each rendering uses the fitted pose and exposure (`render_fitted`). Raises InvalidInputError if
    there are no views.
    """
    if not views:
        raise InvalidInputError("held-out views: expected at least one frame with depth, got none")
    scores: dict[str, list[ViewScore]] = {name: [] for name in viewers}
    by_task: dict[str, dict[str, list[ViewScore]]] = {task: {name: [] for name in viewers} for task in task_regions}
    shown = largest_roi_views(views, sheets)
    pictures = {}
    for i, view in enumerate(views):
        renderings: dict[str, Float32[ndarray, "h w 3"]] = {}
        of_tasks = {task: HeldOutView.of(view.frame, regions) for task, regions in task_regions.items()}
        for name, viewer in viewers.items():
            rendering = render_fitted(viewer, view.frame) if fit_views else viewer.render_frame(view.frame)
            scores[name].append(score_view(rendering, view))
            for task, task_view in of_tasks.items():
                by_task[task][name].append(score_view(rendering, task_view))
            renderings[name] = rendering.rgb
        if i in shown:
            pictures[f"{i:03d}-frame-{view.frame.index:06d}"] = comparison_sheet(view, renderings)
    means = {task: {name: average(of_map) for name, of_map in maps.items()} for task, maps in by_task.items()}
    return TeamScores({name: average(of_map) for name, of_map in scores.items()}, means, pictures)


def team_sentence(psnr: Mapping[str, Mapping[str, float | None]]) -> str:
    """Return how good the voted map is everywhere, and what each robot's own map lacks most in comparison.

    psnr: of each map by name, in each task's region and in whole images. Empty without a voted map or without figures.
    """
    voted = {place: maps.get(TEAM_MAP) for place, maps in psnr.items()}
    shown = [f"{value:.1f} dB PSNR in {place}" for place, value in voted.items() if value is not None]
    lacks = []
    for name in {name: None for maps in psnr.values() for name in maps if name not in MAP_PURPOSES}:
        gaps_db = {
            place: value - own
            for place, value in voted.items()
            if value is not None and (own := psnr[place].get(name)) is not None
        }
        if gaps_db:
            place = max(gaps_db, key=gaps_db.__getitem__)
            lacks.append(
                f"{name} alone has {gaps_db[place]:.1f} dB less in {place}"
                if gaps_db[place] > 0
                else f"{name} alone has no less"
            )
    if not shown or not lacks:
        return ""
    return f"One map for all tasks: the voted map has {', '.join(shown)}; {', '.join(lacks)}."
