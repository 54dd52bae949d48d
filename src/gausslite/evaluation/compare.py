"""Score maps on held-out views, inside the task's region and over the whole image (Sec. IV-A, metrics).

Averages are those of the field: each view has its own PSNR, SSIM and depth error (inside the region, over the
region's pixels of that view), and a map's score is the mean over the views. Views that show fewer than
MIN_ROI_PIXELS of the region count for the whole image only. A view's PSNR is at most MAX_PSNR_DB. SSIM is the plain one,
not the multi-scale variant.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Shaped
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.errors import InvalidInputError
from gausslite.evaluation.metrics import covered_share, depth_l1_m, psnr, ssim_map
from gausslite.evaluation.views import HeldOutView, MapViewer
from gausslite.render.rasterizer import Rasterizer, Rendering

MAX_PSNR_DB = 100.0
"""A view's PSNR where map and photograph are equal, as in a saturated region: with infinity no mean would be left."""
_COVERED_ALPHA = 0.5


@runtime_checkable
class PerceptualDistance(Protocol):
    """How different two images look, pixel by pixel."""

    def distance_map(self, a: Shaped[ndarray, "h w 3"], b: Shaped[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        """0 where they look the same. Images are uint8, or floating in [0, 1]."""
        ...


@dataclass(frozen=True, slots=True)
class RoiScore:
    """One view's figures inside the region. covered: share of its pixels with measured depth that the map draws, with
    alpha above 0.5; depth error is known there alone.
    """

    psnr: float
    ssim: float
    depth_l1_m: float | None
    covered: float | None
    lpips: float | None = None


@dataclass(frozen=True, slots=True)
class ViewScore:
    """One view's figures; roi is None where the view shows too little of the region."""

    index: int
    psnr: float
    ssim: float
    roi_pixels: int
    roi: RoiScore | None
    depth_l1_m: float | None = None
    lpips: float | None = None


@dataclass(frozen=True, slots=True)
class MapScores:
    """Means over the views: PSNR in dB, depth in metres, coverage a share. None where no view has such a figure, or
    LPIPS had no weights.

    n_views and n_roi_views count the views behind the full and the ROI figures; roi_pixels sums the region's pixels
    over the latter.
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
    roi_lpips: float | None = None
    full_lpips: float | None = None


def evaluate(gaussians: Gaussians, views: Sequence[HeldOutView], rasterizer: Rasterizer) -> MapScores:
    """Draw the map from every held-out view and average. Raises InvalidInputError without views."""
    viewer = MapViewer(gaussians, rasterizer)
    return average([score_view(viewer.render_frame(view.frame), view) for view in views])


def score_view(drawn: Rendering, view: HeldOutView, perceptual: PerceptualDistance | None = None) -> ViewScore:
    """Compare one rendering with its frame; LPIPS is left out without a network for it."""
    rgb = view.frame.rgb
    similarity = ssim_map(drawn.rgb, rgb)
    depth_m = drawn.expected_depth_m(_COVERED_ALPHA)
    distance = None if perceptual is None else perceptual.distance_map(drawn.rgb, rgb)
    roi = None
    if view.shows_region:
        roi = RoiScore(
            min(psnr(drawn.rgb, rgb, view.roi), MAX_PSNR_DB),
            float(similarity[view.roi].mean()),
            depth_l1_m(depth_m, view.frame.depth_m, view.roi),
            covered_share(depth_m, view.frame.depth_m, view.roi),
            None if distance is None else float(distance[view.roi].mean()),
        )
    return ViewScore(
        index=view.frame.index,
        psnr=min(psnr(drawn.rgb, rgb), MAX_PSNR_DB),
        ssim=float(similarity.mean()),
        roi_pixels=int(np.count_nonzero(view.roi)),
        roi=roi,
        depth_l1_m=depth_l1_m(depth_m, view.frame.depth_m),
        lpips=None if distance is None else float(distance.mean()),
    )


def average(scores: Sequence[ViewScore]) -> MapScores:
    """The map's scores from its views' scores. Raises InvalidInputError without views."""
    if not scores:
        raise InvalidInputError("held-out views: expected at least one, got none")
    rois = [score.roi for score in scores if score.roi is not None]
    return MapScores(
        roi_psnr=_mean_or_none(roi.psnr for roi in rois),
        roi_ssim=_mean_or_none(roi.ssim for roi in rois),
        full_psnr=fmean(score.psnr for score in scores),
        full_ssim=fmean(score.ssim for score in scores),
        roi_depth_l1_m=_mean_or_none(roi.depth_l1_m for roi in rois if roi.depth_l1_m is not None),
        roi_covered=_mean_or_none(roi.covered for roi in rois if roi.covered is not None),
        n_views=len(scores),
        n_roi_views=len(rois),
        roi_pixels=sum(score.roi_pixels for score in scores if score.roi is not None),
        full_depth_l1_m=_mean_or_none(score.depth_l1_m for score in scores if score.depth_l1_m is not None),
        roi_lpips=_mean_or_none(roi.lpips for roi in rois if roi.lpips is not None),
        full_lpips=_mean_or_none(score.lpips for score in scores if score.lpips is not None),
    )


def _mean_or_none(values: Iterable[float]) -> float | None:
    listed = list(values)
    return fmean(listed) if listed else None
